"""Stage train: a small ReLU actor by Stable-Baselines3, in segments, with the best of its evaluations kept.

A segment is the steps between two evaluations (PPO: rounded up to whole rollouts). It starts with new environments and
random streams of its own, so what it does depends on the checkpoint before it alone: a killed and resumed run equals an
uninterrupted one bit for bit.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger

import otr
from pipelines.algorithms import build_env, build_model
from pipelines.checkpoint import History, load_checkpoint, save_checkpoint
from pipelines.config import RunConfig
from pipelines.envs import state_box
from pipelines.errors import PipelineError, PolicyMismatchError
from pipelines.policies import answers_agree
from pipelines.progress import TrainingProgress
from pipelines.rollout import Rollout, rollout
from pipelines.seeding import episode_seeds, stream_seed
from pipelines.store import save_actor, write_csv
from pipelines.tracking import open_tracker
from pipelines.training import checkpoint_folder, segment_steps

TOLERANCE = 1e-5  # between the float64 network and Stable-Baselines3's float32 one, relative
FLOAT32_ROUNDING = 1e-6  # of the sum of all terms' sizes: some eight roundings
EVALUATION_COLUMNS = ("steps", "return_mean", "return_std", "n_episodes", "best")
PROGRESS_COLUMNS = ("steps", "seconds", "steps_per_s", "n_episodes", "episode_return_mean", "episode_length_mean")


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
    assert history.best is not None
    save_actor(history.best, out)
    write_csv(out / "evaluations.csv", history.evaluations, EVALUATION_COLUMNS)
    write_csv(out / "progress.csv", history.progress, PROGRESS_COLUMNS)


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
            progress_row = _train_segment(model, config, history.n_segments, progress)
            network, played = _evaluate(model, config)
            history.n_segments += 1
            history.progress.append(progress_row)
            history.evaluations.append(_evaluation_row(model, played, history))
            if history.evaluations[-1]["best"]:
                history.best = network
            save_checkpoint(checkpoints, model, history, start)
            progress.segment_done(start, progress_row, history.evaluations[-1])
            tracker.segment_done(progress_row, history.evaluations[-1])
    return history


def _train_segment(model: BaseAlgorithm, config: RunConfig, segment: int, progress: TrainingProgress) -> dict[str, Any]:
    """Train for one segment and return its row of `progress.csv`."""
    start = model.num_timesteps
    n_steps = min(segment_steps(config), config.train.steps - start)
    model.set_logger(Logger(folder=None, output_formats=[]))  # its default leaves a temporary folder every segment
    model.set_env(build_env(config), force_reset=True)
    model.set_random_seed(stream_seed(config.seed, "train", segment))
    began = time.monotonic()
    model.learn(n_steps, callback=progress.callback, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
    seconds = time.monotonic() - began
    assert model.env is not None
    returns = np.concatenate([*model.env.env_method("get_episode_rewards"), []])
    lengths = np.concatenate([*model.env.env_method("get_episode_lengths"), []])
    model.env.close()
    return {
        "steps": model.num_timesteps,
        "seconds": round(seconds, 3),
        "steps_per_s": round((model.num_timesteps - start) / seconds, 1),
        "n_episodes": len(returns),
        "episode_return_mean": float(returns.mean()) if len(returns) else None,
        "episode_length_mean": float(lengths.mean()) if len(lengths) else None,
    }


def _evaluate(model: BaseAlgorithm, config: RunConfig) -> tuple[otr.ReluNetwork, Rollout]:
    """Play the selection episodes with the exported network, and compare it with the model on every state visited."""
    try:
        network = otr.from_sb3(model)
    except otr.InvalidNetworkError as error:
        raise PipelineError(
            f"the actor after step {model.num_timesteps:,} is no network ({error}); if numbers are not finite, the "
            "training diverged: try a smaller algo.learning_rate"
        ) from error
    middle, half_width = np.zeros(1), np.ones(1)
    if config.actor.rescale_inputs:
        middle, half_width = state_box(config.env)
        network = network.fold_input_normalisation(middle, half_width)
    seeds = episode_seeds(config.seed, "selection", config.train.n_selection_episodes)
    played = rollout(network.predict, config.env, seeds, keep_states=True, n_workers=1)
    compare_with_model(network, model, played.states, (played.states - middle) / half_width)
    return network, played


def compare_with_model(network: otr.ReluNetwork, model: BaseAlgorithm, states: np.ndarray, seen: np.ndarray) -> None:
    """Raise PolicyMismatchError where network and model disagree by more than TOLERANCE on a state.

    The model computes in float32, whose rounding grows with the terms that are summed up, not with their sum; that much
    is allowed for, as bounded by the network of the absolute weights on the absolute states.

    Args:
        network: the exported network.
        model: the trained model.
        states: (n, d), as the network reads them.
        seen: (n, d), the same states as the model was trained on them.
    """
    ours, outputs = network.predict(states), network.forward(states)
    theirs, _ = model.predict(seen.astype(np.float32), deterministic=True)
    sizes = otr.ReluNetwork(
        [np.abs(weight) for weight in network.weights], [np.abs(bias) for bias in network.biases], dense=network.dense
    ).forward(np.abs(states))
    wrong = ~answers_agree(ours, theirs, outputs, TOLERANCE, slack=FLOAT32_ROUNDING * sizes)
    if wrong.any():
        i = int(np.flatnonzero(wrong)[0])
        raise PolicyMismatchError(
            f"the exported network is not the trained policy: in state {states[i].tolist()} the network does "
            f"{ours[i].tolist()}, Stable-Baselines3's predict {theirs[i].tolist()}"
        )


def _evaluation_row(model: BaseAlgorithm, played: Rollout, history: History) -> dict[str, Any]:
    mean = float(played.returns.mean())
    best = all(mean > row["return_mean"] for row in history.evaluations)
    return {
        "steps": model.num_timesteps,
        "return_mean": mean,
        "return_std": float(played.returns.std()),
        "n_episodes": len(played.returns),
        "best": best,
    }
