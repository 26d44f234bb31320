"""States and rewards normalised by what training has met, under PPO: Stable-Baselines3's VecNormalize.

States are not clipped, so that what training sees is an affine function of the environment's own states, and the actor
that is kept reads these: the function is folded into it.
"""

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from pipelines.config.algo import PpoConfig
from pipelines.play.selection import InputUnits, units_of_box
from pipelines.training.settings import TrainSettings


def normalised(env: VecEnv, config: TrainSettings) -> VecEnv:
    """Return the environments of a run, normalised where its algorithm is set so."""
    algo = config.algo
    if not (isinstance(algo, PpoConfig) and algo.normalise):
        return env
    return VecNormalize(env, clip_obs=np.inf, gamma=algo.gamma)


def hand_on_statistics(model: BaseAlgorithm, env: VecEnv) -> VecEnv:
    """Return new environments for a model, which go on from the statistics of its last ones."""
    before = model.get_vec_normalize_env()
    if before is not None:
        assert isinstance(env, VecNormalize)
        env.obs_rms, env.ret_rms = before.obs_rms, before.ret_rms
    return env


def input_units(model: BaseAlgorithm, config: TrainSettings) -> InputUnits | None:
    """Return the units in which a model sees states; None for the environment's own."""
    env = model.get_vec_normalize_env()
    if env is None:
        return units_of_box(config.env, config.actor.rescale_inputs)
    states = env.obs_rms
    assert isinstance(states, RunningMeanStd)
    return InputUnits(states.mean, np.sqrt(states.var + env.epsilon))


def statistics(model: BaseAlgorithm) -> dict[str, torch.Tensor]:
    """Return the statistics of a model's environments by name; none where they are not normalised."""
    return {
        f"{kind}.{name}": torch.as_tensor(getattr(running, name), dtype=torch.float64)
        for kind, running in _running(model).items()
        for name in ("mean", "var", "count")
    }


def set_statistics(model: BaseAlgorithm, saved: dict[str, torch.Tensor]) -> None:
    """Bring a model's environments to what `statistics` returned."""
    for kind, running in _running(model).items():
        running.mean, running.var = saved[f"{kind}.mean"].numpy(), saved[f"{kind}.var"].numpy()
        running.count = float(saved[f"{kind}.count"])


def _running(model: BaseAlgorithm) -> dict[str, RunningMeanStd]:
    env = model.get_vec_normalize_env()
    if env is None:
        return {}
    assert isinstance(env.obs_rms, RunningMeanStd)
    return {"states": env.obs_rms, "returns": env.ret_rms}
