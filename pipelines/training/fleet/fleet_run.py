"""One run of a fleet: its history, what it has learnt, its replay file, and the checkpoint that holds all of it."""

from pathlib import Path

import torch
from safetensors.torch import load_file
from safetensors.torch import save as safetensors_bytes
from torch import Tensor

from pipelines.config.algo import SacConfig
from pipelines.config.run import RunConfig
from pipelines.engine.seeding import stream_seed, stream_seeds
from pipelines.tracking.tracker import Tracker
from pipelines.training.checkpoints import History, last_segment, read_segment, write_segment
from pipelines.training.estimates import segment_steps
from pipelines.training.fleet.adam import RunSettings
from pipelines.training.fleet.replay_buffer import RowLayout, open_rows

STATE_FILE = "learner.safetensors"


class FleetRun:
    """A run as it stands at its last whole segment.

    Attributes:
        config, folder: the run and its checkpoints.
        history: segments, evaluations, the best actor.
        n_steps, n_updates: environment steps and updates done.
        tensors: what it has learnt, by the names of `FleetSac.tensors`; empty before the first segment.
        error: why it was given up.
    """

    def __init__(self, config: RunConfig, folder: Path, layout: RowLayout) -> None:
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
        self.tracker = Tracker(config)
        self.tracker.catch_up(self.history.progress, self.history.evaluations)
        self.rows = open_rows(self.folder / "replay.bin", self._capacity, layout, config.train.steps, self.n_steps)

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
        """What the learner takes for this run alone."""
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
        write_segment(self.folder, self.history, counters, (STATE_FILE, safetensors_bytes(self.tensors)))

    @property
    def _capacity(self) -> int:
        return self.buffer_size + segment_steps(self.config)
