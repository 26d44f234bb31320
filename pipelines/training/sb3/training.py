"""Training by Stable-Baselines3: in segments, the best of their evaluations kept.

A segment is the steps between two evaluations (PPO: rounded up to whole rollouts). It starts with new environments and
random streams of its own, so what it does depends on the checkpoint before it alone: a killed and resumed run equals an
uninterrupted one bit for bit.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger

from otr.learners.networks.denormals import denormals_as_zero
from pipelines.engine.seeding import stream_seed
from pipelines.errors import PipelineError
from pipelines.tracking.tracker import Tracker
from pipelines.training.checkpoints import progress_row
from pipelines.training.estimates import segment_steps
from pipelines.training.progress import TrainingProgress
from pipelines.training.sb3.actor_kinds import actor_of
from pipelines.training.sb3.models import build_env, build_model
from pipelines.training.sb3.normalisation import hand_on_statistics
from pipelines.training.sb3.relu_actor import ReluActor
from pipelines.training.sb3.saved_models import load_checkpoint, save_checkpoint
from pipelines.training.settings import TrainSettings


def train_by_sb3(config: TrainSettings, checkpoints: Path, out: Path) -> None:
    """Train, going on from a checkpoint where there is one; write the best actor and the curves' CSV files into `out`.

    Raises:
        PipelineError: the training diverged.
        PolicyMismatchError: the exported network and Stable-Baselines3's policy disagree on a visited state.
    """
    checkpoints.mkdir(parents=True, exist_ok=True)
    model, actor = build_model(config, stream_seed(config.seed, "train")), actor_of(config)
    history = load_checkpoint(checkpoints, model)
    tracker = Tracker(config)
    tracker.catch_up(history.progress, history.evaluations)
    with TrainingProgress(config, model.num_timesteps) as progress:
        while model.num_timesteps < config.train.steps:
            start = model.num_timesteps
            row = train_segment(model, actor, history.n_segments, progress)
            files, played = actor.evaluate(model)
            history.segment_done(row, files, played.returns)
            save_checkpoint(checkpoints, model, history, start)
            progress.segment_done(row, history.evaluations[-1])
            tracker.segment_done(row, history.evaluations[-1])
    history.write(out)


def train_segment(model: BaseAlgorithm, actor: ReluActor, segment: int, progress: TrainingProgress) -> dict[str, Any]:
    """Train for one segment and return its row of `progress.csv`."""
    config, start = actor.config, model.num_timesteps
    n_steps = min(segment_steps(config), config.train.steps - start)
    model.set_logger(Logger(folder=None, output_formats=[]))  # its default leaves a temporary folder every segment
    model.set_env(hand_on_statistics(model, build_env(config)), force_reset=True)
    model.set_random_seed(stream_seed(config.seed, "train", segment))
    if isinstance(model, DQN):  # its first action comes before its schedule is asked
        model.exploration_rate = model.exploration_schedule(1.0)
    began = time.monotonic()
    callbacks = CallbackList([_TellsTheStep(progress), *actor.callbacks()])
    try:
        with denormals_as_zero():
            model.learn(n_steps, callback=callbacks, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
    except ValueError as error:  # torch's, of the parameters of a distribution
        _check_experience(model)
        raise error
    actor.segment_learnt(model)
    seconds = time.monotonic() - began
    assert model.env is not None
    returns = np.concatenate([*model.env.env_method("get_episode_rewards"), []])
    lengths = np.concatenate([*model.env.env_method("get_episode_lengths"), []])
    model.env.close()
    return progress_row(model.num_timesteps, start, seconds, returns, lengths)


def _check_experience(model: BaseAlgorithm) -> None:
    """Raise PipelineError where the environment gave numbers that are not finite."""
    last, kept = model._last_obs, getattr(model, "replay_buffer", None) or getattr(model, "rollout_buffer", None)
    observations = [each for each in (last, kept and kept.observations) if isinstance(each, np.ndarray)]
    for what, arrays in (("observations", observations), ("rewards", [kept.rewards] if kept else [])):
        if not all(np.isfinite(array).all() for array in arrays):
            raise PipelineError(f"step {model.num_timesteps:,}: the environment's {what} are not finite")


class _TellsTheStep(BaseCallback):
    def __init__(self, progress: TrainingProgress) -> None:
        super().__init__()
        self._progress = progress

    def _on_step(self) -> bool:
        self._progress.at_step(self.num_timesteps)
        return True
