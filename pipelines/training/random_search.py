"""Linear policies by augmented random search (Mania et al. 2018), sb3-contrib's."""

from sb3_contrib import ARS
from stable_baselines3.common.vec_env import VecEnv

from pipelines.config.algo import ArsConfig
from pipelines.errors import ConfigError


def build_ars(env: VecEnv, config: ArsConfig, seed: int) -> ARS:
    """Return an untrained model, a policy of zeros; `otr.from_sb3` reads it as a network without hidden layers.

    The weights that it searches around share the memory of its policy's parameters, so that a checkpoint of those
    resumes it. `learn` ends after the update under way: an update is 2 n_delta whole episodes, however long they are.

    Raises:
        ConfigError: several environments, whose steps it would count wrongly, or more directions used than tried.
    """
    if env.num_envs != 1:
        raise ConfigError(f"algo=ars plays one episode at a time, but there are {env.num_envs} environments; use one")
    if config.n_top > config.n_delta:
        raise ConfigError(f"algo.n_top={config.n_top} is more than algo.n_delta={config.n_delta}")
    return ARS(
        "LinearPolicy",
        env,
        n_delta=config.n_delta,
        n_top=config.n_top,
        learning_rate=config.learning_rate,
        delta_std=config.delta_std,
        policy_kwargs={"with_bias": config.with_bias},
        seed=seed,
        device="cpu",
    )
