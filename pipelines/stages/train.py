"""Stage train: a small ReLU actor, or a soft tree, by Stable-Baselines3, in segments, the best of its evaluations kept.

A segment is the steps between two evaluations (PPO: rounded up to whole rollouts). It starts with new environments and
random streams of its own, so what it does depends on the checkpoint before it alone: a killed and resumed run equals an
uninterrupted one bit for bit.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

import otr
from pipelines.config import PidConfig, RunConfig
from pipelines.engine.seeding import stream_seed
from pipelines.play.actor_files import actor_files
from pipelines.play.rollout import Rollout
from pipelines.play.selection import compare_with_trained, diverged, play_episodes, play_selection_episodes
from pipelines.tracking.tracker import open_tracker
from pipelines.training.checkpoints import History, progress_row
from pipelines.training.estimates import checkpoint_folder, segment_steps
from pipelines.training.pid_policies import exported_network, zero_small_weights
from pipelines.training.progress import TrainingProgress
from pipelines.training.sb3_checkpoints import load_checkpoint, save_checkpoint
from pipelines.training.sb3_models import build_env, build_model
from pipelines.training.soft_policies import SoftSchedule, exported_module, harden, schedule_of, shape_of, soft_files


def train(inputs: Mapping[str, Path], config: RunConfig, out: Path) -> None:
    """Train, and write the best actor, `evaluations.csv` and `progress.csv` into `out`.

    The checkpoint stays: whoever has put `out` in its place deletes it.

    Raises:
        PolicyMismatchError: the exported network and Stable-Baselines3's policy disagree on a visited state.
        KeyboardInterrupt: Ctrl-C; the checkpoint of the last whole segment stays.
    """
    checkpoints = checkpoint_folder(config)
    checkpoints.mkdir(parents=True, exist_ok=True)
    history = _train_segments(config, checkpoints)
    history.write(out)


def _train_segments(config: RunConfig, checkpoints: Path) -> History:
    model = build_model(config, stream_seed(config.seed, "train"))
    history = load_checkpoint(checkpoints, model)
    n_steps = config.train.steps
    tracker = open_tracker(config)
    for rows in zip(history.progress, history.evaluations, strict=True):
        tracker.segment_done(*rows)  # a kill may have come between a checkpoint and its log
    with TrainingProgress(config, model.num_timesteps) as progress:
        while model.num_timesteps < n_steps:
            start = model.num_timesteps
            row = _train_segment(model, config, history.n_segments, progress)
            history.segment_done(row, *_evaluate(model, config))
            save_checkpoint(checkpoints, model, history, start)
            progress.segment_done(start, row, history.evaluations[-1])
            tracker.segment_done(row, history.evaluations[-1])
    return history


def _train_segment(model: BaseAlgorithm, config: RunConfig, segment: int, progress: TrainingProgress) -> dict[str, Any]:
    """Train for one segment and return its row of `progress.csv`."""
    start = model.num_timesteps
    n_steps = min(segment_steps(config), config.train.steps - start)
    model.set_logger(Logger(folder=None, output_formats=[]))  # its default leaves a temporary folder every segment
    model.set_env(build_env(config), force_reset=True)
    model.set_random_seed(stream_seed(config.seed, "train", segment))
    if isinstance(model, DQN):  # its first action comes before its schedule is asked
        model.exploration_rate = model.exploration_schedule(1.0)
    began = time.monotonic()
    model.learn(n_steps, callback=_callbacks(config, progress), log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
    if isinstance(config.method, PidConfig):
        zero_small_weights(model, config.method.zero_below)
    seconds = time.monotonic() - began
    assert model.env is not None
    returns = np.concatenate([*model.env.env_method("get_episode_rewards"), []])
    lengths = np.concatenate([*model.env.env_method("get_episode_lengths"), []])
    model.env.close()
    return progress_row(model.num_timesteps, start, seconds, returns, lengths)


def _callbacks(config: RunConfig, progress: TrainingProgress) -> CallbackList:
    """Return what goes on beside the learning: the progress bar, and a soft tree's schedule."""
    callbacks: list[BaseCallback] = [progress.callback] if progress.callback else []
    if config.method.is_soft:
        callbacks.append(SoftSchedule(schedule_of(config)))
    return CallbackList(callbacks)


def _evaluate(model: BaseAlgorithm, config: RunConfig) -> tuple[dict[str, bytes], Rollout]:
    """Play the selection episodes with what the actor becomes, its network or its hard tree; return the actor's files.

    A network is compared with the model on every state visited.
    """
    if config.method.is_soft:
        assert isinstance(model, OnPolicyAlgorithm)
        module = exported_module(model, config)
        try:
            tree = harden(module, model.action_space)
        except otr.InvalidTreeError as error:
            raise diverged(model.num_timesteps, error) from error
        return soft_files(module, shape_of(config)), play_episodes(tree.predict, config)
    try:
        network = exported_network(model) if isinstance(config.method, PidConfig) else otr.from_sb3(model)
    except otr.InvalidNetworkError as error:
        raise diverged(model.num_timesteps, error) from error
    network, played = play_selection_episodes(network, config)
    compare_with_trained(network, lambda states: model.predict(states, deterministic=True)[0], played.states, config)
    return actor_files(network), played
