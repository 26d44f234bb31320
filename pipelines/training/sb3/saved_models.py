"""What a checkpoint holds of a Stable-Baselines3 model.

The model's parameters and optimiser states are read with `weights_only`, so nothing in them can run. The replay buffer
is a log: each segment's transitions are one file, written once and never changed, so saving costs as much as a segment
collected, not as much as the buffer holds.
"""

import io
import zipfile
import zlib
from pathlib import Path

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from pipelines.engine.store import replacing
from pipelines.errors import PipelineError
from pipelines.training.checkpoints import History, damaged_checkpoint, last_segment, read_segment, write_segment
from pipelines.training.sb3.normalisation import set_statistics, statistics

COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_n_calls")
REPLAY_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def save_checkpoint(folder: Path, model: BaseAlgorithm, history: History, replay_start: int) -> None:
    """Write the checkpoint of a segment's end; `replay_start` transitions were collected before the segment began."""
    folder.mkdir(parents=True, exist_ok=True)
    if isinstance(model, OffPolicyAlgorithm):
        _write_replay(folder, model, replay_start, history.n_segments)
    # Through a buffer: torch would report a full disk as an internal error.
    buffer = io.BytesIO()
    state = {"parameters": model.get_parameters(), "tensors": _loose_tensors(model), "statistics": statistics(model)}
    torch.save(state, buffer)
    counters = {name: int(getattr(model, name)) for name in COUNTERS if hasattr(model, name)}
    write_segment(folder, history, counters, {"model.pt": buffer.getvalue()})


def load_checkpoint(folder: Path, model: BaseAlgorithm) -> History:
    """Bring `model` to the last whole segment in `folder` and return the history; an empty one where there is none."""
    segment = last_segment(folder)
    if segment is None:
        return History()
    history, counters = read_segment(segment)
    saved = torch.load(segment / "model.pt", weights_only=True)
    model.set_parameters(saved["parameters"], exact_match=True)
    for name, tensor in saved["tensors"].items():
        getattr(model, name).data.copy_(tensor)
    set_statistics(model, saved.get("statistics", {}))
    for name, value in counters.items():
        setattr(model, name, value)
    if isinstance(model, OffPolicyAlgorithm):
        _read_replay(folder, model, history.n_segments)
    return history


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
    log = folder / f"replay-{segment:06d}-{end:012d}.npz"
    with replacing(log) as temporary, temporary.open("wb") as file:
        np.savez(file, end=end, **{name: getattr(buffer, name)[rows] for name in REPLAY_ARRAYS})
    for log in folder.glob("replay-*.npz"):
        # Until the new checkpoint is in place, a killed run resumes from the one at `start`, which needs its buffer.
        if int(log.stem.split("-")[2]) <= start - buffer.buffer_size:
            log.unlink()


def _read_replay(folder: Path, model: OffPolicyAlgorithm, n_segments: int) -> None:
    """Fill the model's replay buffer from the logs of the first `n_segments` segments."""
    buffer = model.replay_buffer
    assert buffer is not None
    oldest = max(0, model.num_timesteps - buffer.buffer_size)
    is_there = np.zeros(model.num_timesteps - oldest, dtype=np.bool_)
    for log in sorted(folder.glob("replay-*.npz")):
        if int(log.stem.split("-")[1]) > n_segments:
            continue  # written just before the kill, by a segment that has no checkpoint; it will be written again
        try:
            with np.load(log, allow_pickle=False) as saved:
                end = int(saved["end"])
                steps = np.arange(end - len(saved["rewards"]), end)
                rows = steps % buffer.buffer_size
                for name in REPLAY_ARRAYS:
                    getattr(buffer, name)[rows] = saved[name]
        except (EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error) as error:
            raise damaged_checkpoint(log, f"cannot be read: {error}") from error
        is_there[steps[steps >= oldest] - oldest] = True
    if not is_there.all():
        raise PipelineError(
            f"{folder}: {int((~is_there).sum()):,} of {len(is_there):,} transitions of the replay buffer are gone; "
            "bring the replay-*.npz back, or delete the folder to train from the beginning"
        )
    buffer.pos = model.num_timesteps % buffer.buffer_size
    buffer.full = model.num_timesteps >= buffer.buffer_size
