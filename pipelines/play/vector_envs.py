"""Environments side by side (`otr.control.environments.VectorEnv`) by who computes them."""

from functools import partial

from otr.control.environments import GymnasiumVectorEnv, VectorEnv
from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.classic_control import EQUAL_IDS, ClassicControlVectorEnv
from pipelines.play.spaces import make_training_env


def make_vector_env(env: EnvConfig, environments: str, *, rescale_inputs: bool = False) -> VectorEnv:
    """Return environments in which a policy is trained or searched for, which "gymnasium" or "numpy" computes.

    With `rescale_inputs` gymnasium's states are rescaled from their box to [-1, 1].

    Raises:
        ConfigError: as `check_environments`, or there is no such environment, or no box of states to rescale.
    """
    check_environments(env, environments)
    if environments == "numpy":
        return ClassicControlVectorEnv(env)
    # The environments of conf/env take actions as they are, in float64 from searches: committed searches stay
    # bit for bit. All others, which may require it, get actions of their own space.
    make = partial(make_training_env, env, rescale_inputs=rescale_inputs)
    return GymnasiumVectorEnv(make, reads_answers=not env.has_file)


def check_environments(env: EnvConfig, environments: str) -> None:
    """Raise ConfigError unless `environments` computes this one as gymnasium does."""
    if environments == "gymnasium":
        return
    others = sorted(env.kwargs.keys() - {"max_episode_steps"})
    if env.id not in EQUAL_IDS:
        reason = f"{env.id} is not among those that were compared with gymnasium's ({', '.join(EQUAL_IDS)})"
    elif others:
        reason = f"{env.id} is compared without arguments, but env.kwargs has {', '.join(others)}"
    elif env.pid is not None:
        reason = "there are no states of PID policies"
    else:
        return
    raise ConfigError(f"environments={environments}: {reason}; use environments=gymnasium")


def fastest_environments(env: EnvConfig) -> str:
    """Return "numpy" where that computes an environment as gymnasium does, else "gymnasium"."""
    return "numpy" if env.id in EQUAL_IDS and not env.kwargs and env.pid is None else "gymnasium"
