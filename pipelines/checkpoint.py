"""Checkpoints of a training run: whole segments, so that a killed run goes on bit for bit as if it had not been.

A checkpoint is the model's parameters and optimiser states (read with `weights_only`, so nothing in it can run), its
counters, the history and the best actor so far. The replay buffer is a log: each segment's transitions are one file,
written once and never changed, so saving costs what a segment collected and not what the buffer holds.
"""

import io
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

import otr
from pipelines.store import load_actor, read_json, save_actor, write_json

COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")
REPLAY_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


@dataclass
class History:
    """What a run has come to after `n_segments` whole segments."""

    n_segments: int = 0
    progress: list[dict[str, Any]] = field(default_factory=list)
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    best: otr.ReluNetwork | None = None


def save_checkpoint(folder: Path, model: BaseAlgorithm, history: History, replay_start: int) -> None:
    """Write the checkpoint of a segment's end beside the last one, then make it the current one.

    Args:
        folder: the run's checkpoint folder.
        model: the model after the segment.
        history: the history, the segment included.
        replay_start: transitions collected before the segment began.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if isinstance(model, OffPolicyAlgorithm):
        _write_replay(folder, model, replay_start, history.n_segments)
    temporary = folder / "next"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    # Through a buffer: torch reports a full disk as an internal failure of its own, a file as what it is.
    buffer = io.BytesIO()
    torch.save({"parameters": model.get_parameters(), "tensors": _loose_tensors(model)}, buffer)
    (temporary / "model.pt").write_bytes(buffer.getvalue())
    counters = {name: int(getattr(model, name)) for name in COUNTERS if hasattr(model, name)}
    write_json(
        temporary / "history.json",
        {
            "n_segments": history.n_segments,
            "counters": counters,
            "progress": history.progress,
            "evaluations": history.evaluations,
        },
    )
    if history.best is not None:
        save_actor(history.best, temporary)
    final = folder / f"segment-{history.n_segments:06d}"
    temporary.rename(final)
    for old in folder.glob("segment-*"):
        if old != final:
            shutil.rmtree(old)


def load_checkpoint(folder: Path, model: BaseAlgorithm) -> History:
    """Bring `model` to the last whole segment in `folder` and return the history; an empty one where there is none."""
    segments = sorted(folder.glob("segment-*"))
    if not segments:
        return History()
    current = segments[-1]
    saved = torch.load(current / "model.pt", weights_only=True)
    model.set_parameters(saved["parameters"], exact_match=True)
    for name, tensor in saved["tensors"].items():
        getattr(model, name).data.copy_(tensor)
    about = read_json(current / "history.json")
    for name, value in about["counters"].items():
        setattr(model, name, value)
    if isinstance(model, OffPolicyAlgorithm):
        _read_replay(folder, model, about["n_segments"])
    best = load_actor(current) if (current / "actor.json").exists() else None
    return History(about["n_segments"], about["progress"], about["evaluations"], best)


def _loose_tensors(model: BaseAlgorithm) -> dict[str, torch.Tensor]:
    """Return the tensors that belong to the model but to none of its modules, such as SAC's log temperature."""
    _, names = model._get_torch_save_params()
    return {name: getattr(model, name).detach() for name in names}


def _write_replay(folder: Path, model: OffPolicyAlgorithm, start: int, segment: int) -> None:
    """Log the transitions `start` to now, and drop the logs that the buffer no longer holds."""
    buffer = model.replay_buffer
    assert buffer is not None
    end = model.num_timesteps
    rows = np.arange(max(start, end - buffer.buffer_size), end) % buffer.buffer_size
    temporary = folder / "replay.tmp"
    with temporary.open("wb") as file:
        np.savez(file, end=end, **{name: getattr(buffer, name)[rows] for name in REPLAY_ARRAYS})
    temporary.rename(folder / f"replay-{segment:06d}-{end:012d}.npz")
    for log in folder.glob("replay-*.npz"):
        # Until the new checkpoint is in its place a kill falls back to the one at `start`, which needs its own buffer.
        if int(log.stem.split("-")[2]) <= start - buffer.buffer_size:
            log.unlink()


def _read_replay(folder: Path, model: OffPolicyAlgorithm, n_segments: int) -> None:
    """Fill the model's replay buffer from the logs of the first `n_segments` segments."""
    buffer = model.replay_buffer
    assert buffer is not None
    for log in sorted(folder.glob("replay-*.npz")):
        if int(log.stem.split("-")[1]) > n_segments:
            continue  # written just before the kill, by a segment that has no checkpoint; it will be written again
        with np.load(log, allow_pickle=False) as saved:
            end = int(saved["end"])
            rows = np.arange(end - len(saved["rewards"]), end) % buffer.buffer_size
            for name in REPLAY_ARRAYS:
                getattr(buffer, name)[rows] = saved[name]
    buffer.pos = model.num_timesteps % buffer.buffer_size
    buffer.full = model.num_timesteps >= buffer.buffer_size
