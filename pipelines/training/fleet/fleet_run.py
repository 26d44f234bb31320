"""One run of a fleet: its history, what it has learnt, its replay file, and the checkpoint that holds all of it.

The replay file is memory-mapped and its own checkpoint. Its capacity is the buffer's size and a segment more, so that a
segment overwrites no row that the checkpoint before it could sample: after a kill the run goes on from that checkpoint
and writes the same rows again.
"""

import hashlib
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors.torch import load_file
from safetensors.torch import save as safetensors_bytes
from torch import Tensor

from otr.control.sac.adam import RunSettings
from otr.control.sac.replay_buffer import RowLayout
from pipelines.config.algo import SacConfig
from pipelines.engine.seeding import stream_seed, stream_seeds
from pipelines.engine.store import json_text, read_json
from pipelines.errors import PipelineError
from pipelines.tracking.tracker import Tracker
from pipelines.training.checkpoints import History, damaged_checkpoint, last_segment, read_segment, write_segment
from pipelines.training.estimates import segment_steps
from pipelines.training.settings import TrainSettings

STATE_FILE, REPLAY_FILE, DIGESTS_FILE = "learner.safetensors", "replay.bin", "replay.json"


class RowsDigest(NamedTuple):
    """Transitions `start` to `stop` of a run, those of a segment, and the sha256 of their rows."""

    start: int
    stop: int
    sha256: str


class FleetRun:
    """A run as of its last whole segment.

    Attributes:
        config, folder: the run and its checkpoints.
        history: segments, evaluations, the best actor.
        n_steps, n_updates: environment steps and updates done.
        tensors: what it has learnt, by the names of `FleetSac.tensors`; empty before the first segment.
        error: why it was abandoned.
    """

    def __init__(self, config: TrainSettings, folder: Path, layout: RowLayout) -> None:
        self.config, self.folder = config, folder
        self.folder.mkdir(parents=True, exist_ok=True)
        self.history, self.n_steps, self.n_updates = History(), 0, 0
        self.tensors: dict[str, Tensor] = {}
        self.error: Exception | None = None
        segment = last_segment(self.folder)
        if segment is not None:
            self.history, counters = read_segment(segment)
            self.n_steps, self.n_updates = counters["num_timesteps"], counters["n_updates"]
            self.tensors = load_file(segment / STATE_FILE)
        self._start = self.n_steps  # rows before it have the digests of the checkpoint, if any
        self._digests: list[RowsDigest] = []
        self.tracker = Tracker(config)
        self.tracker.catch_up(self.history.progress, self.history.evaluations)
        self.rows = _open_rows(self.folder / REPLAY_FILE, self._capacity, layout, config.train.steps, self.n_steps)
        if segment is not None and (segment / DIGESTS_FILE).is_file():
            self._digests = [RowsDigest(*rows) for rows in read_json(segment / DIGESTS_FILE)]
            self._compare_rows()

    @property
    def algo(self) -> SacConfig:
        """The algorithm's settings."""
        assert isinstance(self.config.algo, SacConfig)
        return self.config.algo

    @property
    def buffer_size(self) -> int:
        """Transitions that an update can sample."""
        return min(self.algo.buffer_size, self.config.train.steps)

    @property
    def settings(self) -> RunSettings:
        """The learner's settings of this run alone."""
        algo = self.algo
        temperature = None if algo.ent_coef == "auto" else float(algo.ent_coef)
        return RunSettings(algo.learning_rate, algo.gamma, algo.weight_decay, temperature)

    @property
    def is_finished(self) -> bool:
        """Whether all steps are done."""
        return self.n_steps >= self.config.train.steps

    @property
    def name(self) -> str:
        """The run in a line of progress."""
        return f"depth {self.config.depth} seed {self.config.seed}"

    def seeds(self, n: int) -> list[int]:
        """Return n seeds of the stream of the segment to come."""
        return stream_seeds(n, self.config.seed, "train", self.history.n_segments)

    def initial_generator(self) -> torch.Generator:
        """Return the generator of the networks' first weights."""
        return torch.Generator().manual_seed(stream_seed(self.config.seed, "train"))

    def save(self) -> None:
        """Make this state the run's checkpoint; its rows of the replay file must be there."""
        counters = {"num_timesteps": self.n_steps, "n_updates": self.n_updates}
        start = self._digests[-1].stop if self._digests else self._start
        self._digests.append(RowsDigest(start, self.n_steps, self._digest(start, self.n_steps)))
        oldest = self.n_steps - self.buffer_size  # that can be sampled; before it the next segment writes
        self._digests = [rows for rows in self._digests if rows.stop > oldest]
        first = self._digests[0]
        if first.start < oldest:
            self._digests[0] = RowsDigest(oldest, first.stop, self._digest(oldest, first.stop))
        digests = json_text(self._digests).encode()
        state = {STATE_FILE: safetensors_bytes(self.tensors), DIGESTS_FILE: digests}
        write_segment(self.folder, self.history, counters, state)

    def _compare_rows(self) -> None:
        """Raise PipelineError where transitions that an update can sample are no longer those that were written."""
        for rows in self._digests:
            if self._digest(rows.start, rows.stop) != rows.sha256:
                raise damaged_checkpoint(self.folder / REPLAY_FILE, "was changed")

    def _digest(self, start: int, stop: int) -> str:
        return hashlib.sha256(self.rows[np.arange(start, stop) % self._capacity].tobytes()).hexdigest()

    @property
    def _capacity(self) -> int:
        return self.buffer_size + segment_steps(self.config)


def _open_rows(path: Path, capacity: int, layout: RowLayout, n_steps: int, n_written: int = 0) -> np.memmap:
    """Return a run's rows, (capacity, width) float32; the file takes the disk of all `n_steps` steps at once.

    Raises:
        OSError: the disk has no room for them. A disk that fills up later would end the process by a signal.
        PipelineError: the run has transitions (`n_written`), and the file is gone or of another size.
    """
    shape = (capacity, layout.width)
    fits = path.exists() and path.stat().st_size == 4 * capacity * layout.width
    if n_written and not fits:
        raise PipelineError(
            f"{path}: the transitions of {n_written:,} steps are gone; bring the file back, or delete {path.parent} to "
            "train from the beginning"
        )
    with path.open("r+b" if fits else "wb") as file:
        file.truncate(4 * capacity * layout.width)
        if hasattr(os, "posix_fallocate"):  # not on macOS
            os.posix_fallocate(file.fileno(), 0, 4 * min(capacity, n_steps) * layout.width)
    return np.memmap(path, dtype=np.float32, mode="r+", shape=shape)
