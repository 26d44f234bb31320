"""Checkpoints of a training run: whole segments, so that a resumed run equals an uninterrupted one bit for bit.

A checkpoint is a folder `segment-<n>` with the learner's state, its counters, the history and the best actor so far. It
is written next to the last one and renamed, then the last one is removed. Each trainer defines its content
(`pipelines/training/sb3/saved_models.py`, `pipelines/training/fleet/fleet_run.py`).
"""

import hashlib
import math
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.engine.store import read_json, unfinished, write_csv, write_files, write_json
from pipelines.errors import PipelineError

EVALUATION_COLUMNS = ("steps", "return_mean", "return_std", "n_episodes", "best")
PROGRESS_COLUMNS = ("steps", "seconds", "steps_per_s", "n_episodes", "episode_return_mean", "episode_length_mean")


@dataclass
class History:
    """The history of a run after `n_segments` whole segments."""

    n_segments: int = 0
    progress: list[dict[str, Any]] = field(default_factory=list)
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    best: dict[str, bytes] = field(default_factory=dict)  # the files of the best actor so far

    def segment_done(self, progress_row: dict[str, Any], actor: dict[str, bytes], returns: np.ndarray) -> None:
        """Add a segment, and keep its actor's files where its selection episodes return more than all before.

        Raises:
            PipelineError: a return is no finite number.
        """
        mean = float(returns.mean())
        if not math.isfinite(mean):
            raise PipelineError(
                f"step {progress_row['steps']:,}: the selection episodes return {mean}; rewards have to be finite"
            )
        best = all(mean > row["return_mean"] for row in self.evaluations)
        self.n_segments += 1
        self.progress.append(progress_row)
        self.evaluations.append(
            {
                "steps": progress_row["steps"],
                "return_mean": mean,
                "return_std": float(returns.std()),
                "n_episodes": len(returns),
                "best": best,
            }
        )
        if best:
            self.best = actor

    def write(self, out: Path) -> None:
        """Write a finished run's best actor, `evaluations.csv` and `progress.csv`."""
        write_files(self.best, out)
        write_csv(out / "evaluations.csv", self.evaluations, EVALUATION_COLUMNS)
        write_csv(out / "progress.csv", self.progress, PROGRESS_COLUMNS)


def progress_row(steps: int, start: int, seconds: float, returns: np.ndarray, lengths: np.ndarray) -> dict[str, Any]:
    """Return the row of `progress.csv` of a segment that began at step `start`, from its finished episodes."""
    return {
        "steps": steps,
        "seconds": round(seconds, 3),
        "steps_per_s": round((steps - start) / seconds, 1),
        "n_episodes": len(returns),
        "episode_return_mean": float(returns.mean()) if len(returns) else None,
        "episode_length_mean": float(lengths.mean()) if len(lengths) else None,
    }


def write_segment(folder: Path, history: History, counters: dict[str, int], state: dict[str, bytes]) -> None:
    """Write the checkpoint of a segment's end next to the last one, then make it the current one.

    The trainer's counters have `num_timesteps` among them; `state` is what was learnt, the files'
    names and contents.
    """
    final, files = folder / f"segment-{history.n_segments:06d}", state | history.best
    with unfinished(final) as temporary:
        for name, content in files.items():
            with (temporary / name).open("wb") as file:
                file.write(content)
                os.fsync(file.fileno())  # the last checkpoint is removed once this one is in its place
        write_json(
            temporary / "history.json",
            {
                "n_segments": history.n_segments,
                "counters": counters,
                "progress": history.progress,
                "evaluations": history.evaluations,
                "best": list(history.best),
                "sha256": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
            },
        )
        temporary.rename(final)
    for old in folder.glob("segment-*"):
        if old != final:
            shutil.rmtree(old)


def last_segment(folder: Path) -> Path | None:
    """Return the folder of the last whole segment; None before the first."""
    return max(folder.glob("segment-*"), default=None)


def evaluations_so_far(folder: Path) -> tuple[list[dict[str, Any]], int]:
    """Return the evaluations of a training under way and its environment steps; (none, 0) before the first segment.

    The training is not disturbed: where it replaces the checkpoint meanwhile, the new one is read.
    """
    while (segment := last_segment(folder)) is not None:
        try:
            about = read_json(segment / "history.json")
        except PipelineError:
            if segment == last_segment(folder):
                raise
            continue
        return about["evaluations"], int(about["counters"]["num_timesteps"])
    return [], 0


def read_segment(segment: Path) -> tuple[History, dict[str, int]]:
    """Return a checkpoint's history and counters.

    Raises:
        PipelineError: a file of it is gone or was changed.
    """
    about = read_json(segment / "history.json")
    for name, wanted in about.get("sha256", {}).items():
        path = segment / name
        if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != wanted:
            raise damaged_checkpoint(path, "was changed" if path.is_file() else "is gone")
    best = {name: (segment / name).read_bytes() for name in about["best"]}
    return History(about["n_segments"], about["progress"], about["evaluations"], best), about["counters"]


def damaged_checkpoint(path: Path, what: str) -> PipelineError:
    """Return the error for a file of a checkpoint, with the remedy."""
    folder = path.parent.parent if path.parent.name.startswith("segment-") else path.parent
    return PipelineError(f"{path} {what}; bring it back, or delete the folder {folder} to train from the beginning")
