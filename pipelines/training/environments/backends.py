"""The implementations of environments by name, and what each was compared for."""

from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.training.environments.classic_control import EQUAL_IDS, ClassicControlVectorEnv
from pipelines.training.environments.gymnasium_envs import GymnasiumVectorEnv
from pipelines.training.environments.vector_envs import VectorEnv

ENVIRONMENTS = ("gymnasium", "numpy")


def make_vector_env(env: EnvConfig, n_envs: int, environments: str) -> VectorEnv:
    """Return environments side by side.

    Args:
        env: which one.
        n_envs: how many, 1 or more.
        environments: who computes them, of ENVIRONMENTS.

    Raises:
        ConfigError: `environments` was not compared with gymnasium for this one; the message names those it was.
    """
    check_environments(env, environments)
    return (GymnasiumVectorEnv if environments == "gymnasium" else ClassicControlVectorEnv)(env, n_envs)


def check_environments(env: EnvConfig, environments: str) -> None:
    """Raise ConfigError unless `environments`, of ENVIRONMENTS, computes this one as gymnasium does."""
    if environments not in ENVIRONMENTS:
        raise ConfigError(f"environments={environments}: use one of {', '.join(ENVIRONMENTS)}")
    if environments != "gymnasium" and env.id not in EQUAL_IDS:
        raise ConfigError(
            f"environments={environments}: {env.id} is not among those that were compared with gymnasium's "
            f"({', '.join(EQUAL_IDS)}); use environments=gymnasium"
        )
