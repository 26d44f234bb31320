"""Training by direct search: in segments, the best of their evaluations kept.

A segment is the iterations until the next evaluation. What an iteration does follows from the run's seed, its number
and what the checkpoint before it holds. So a killed and resumed run equals an uninterrupted one bit for bit on one type
of processor with the same package versions.
"""

import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file
from safetensors.numpy import save as safetensors_bytes

from pipelines.config.algo import ArsConfig
from pipelines.engine.seeding import episode_seeds
from pipelines.play.actor_files import actor_files
from pipelines.play.episodes import Player
from pipelines.tracking.tracker import Tracker
from pipelines.training.checkpoints import History, last_segment, progress_row, read_segment, write_segment
from pipelines.training.estimates import segment_steps
from pipelines.training.progress import TrainingProgress
from pipelines.training.search.policy_search import PolicySearch
from pipelines.training.settings import TrainSettings

STATE_FILE = "search.safetensors"


def train_by_search(config: TrainSettings, checkpoints: Path, out: Path) -> None:
    """Search, going on from a checkpoint where there is one; write the best actor and the curves' files into `out`."""
    assert isinstance(config.algo, ArsConfig)
    checkpoints.mkdir(parents=True, exist_ok=True)
    run = SearchRun(config, checkpoints)
    tracker = Tracker(config)
    tracker.catch_up(run.history.progress, run.history.evaluations)
    with (
        closing(Player(config.env, config.algo.environments)) as player,
        TrainingProgress(config, run.n_steps) as progress,
    ):
        while run.n_steps < config.train.steps:
            row = run.segment(player, progress)
            run.evaluate(player, row)
            run.save()
            progress.segment_done(row, run.history.evaluations[-1])
            tracker.segment_done(row, run.history.evaluations[-1])
    run.history.write(out)


@dataclass
class _Finished:
    """The best search so far of those that had their start."""

    state: dict[str, np.ndarray]
    score: float  # its best evaluation


class SearchRun:
    """A run's searches as of the last whole segment.

    The first `n_starts` searches begin from networks of their own and do `start_steps` each; the one with the best
    evaluation then goes on, for as many steps as a start had at least: a short run has shorter starts.

    Attributes:
        history: segments, evaluations, the best actor.
        n_steps: environment steps of all searches together.
    """

    def __init__(self, config: TrainSettings, checkpoints: Path) -> None:
        assert isinstance(config.algo, ArsConfig)
        self._config, self._algo, self._checkpoints = config, config.algo, checkpoints
        self._start_steps = min(self._algo.start_steps, config.train.steps // (self._algo.n_starts + 1))
        self.history, self.n_steps, self._start = History(), 0, 0
        self._score = -np.inf  # the best evaluation of the search under way
        self._leader: _Finished | None = None
        segment = last_segment(checkpoints)
        if segment is None:
            self._search = PolicySearch(config, 0)
            return
        self.history, counters = read_segment(segment)
        self.n_steps, self._start = counters["num_timesteps"], counters["start"]
        self._search = PolicySearch(config, self._start)
        state = load_file(segment / STATE_FILE)
        leader = {name.removeprefix("leader_"): array for name, array in state.items() if name.startswith("leader_")}
        if leader:
            self._leader = _Finished(leader, float(leader.pop("score")))
        self._score = float(state["score"])
        self._search.restore(state)

    @property
    def _is_choosing(self) -> bool:
        """Whether the search under way is one of those of which the best goes on."""
        return self._start < self._algo.n_starts and self._algo.n_starts > 1

    def segment(self, player: Player, progress: TrainingProgress) -> dict[str, Any]:
        """Search up to the next evaluation; return the row of `progress.csv`."""
        config, search = self._config, self._search
        start, began = self.n_steps, time.monotonic()
        most = start + segment_steps(config)
        if self._is_choosing:
            most = min(most, start + max(1, self._start_steps - search.n_steps))
        # A search that continues has done its own steps, and does all that are left.
        whole = config.train.steps - self.n_steps + search.n_steps
        returns, lengths = [], []
        while self.n_steps < min(most, config.train.steps):
            played = search.iterate(player, search.n_steps / whole)
            returns.append(played.returns.ravel())
            lengths.append(played.lengths.ravel())
            self.n_steps += int(played.lengths.sum())
            progress.at_step(self.n_steps)
        seconds = time.monotonic() - began
        return progress_row(self.n_steps, start, seconds, np.concatenate(returns), np.concatenate(lengths))

    def evaluate(self, player: Player, row: dict[str, Any]) -> None:
        """Play the selection episodes with the current actor, and begin the next search where it is time."""
        network = self._search.network
        seeds = episode_seeds(self._config.seed, "selection", self._config.train.n_selection_episodes)
        played = player.play([network], np.array([seeds]))
        self.history.segment_done(row, actor_files(network), played.returns[0])
        self._score = max(self._score, float(played.returns.mean()))
        if self._is_choosing and self._search.n_steps >= self._start_steps:
            self._next_search()

    def _next_search(self) -> None:
        """Begin the next search, or go on with the best of them after the last."""
        if self._leader is None or self._score > self._leader.score:
            self._leader = _Finished(self._search.state(), self._score)
        self._start += 1
        self._search, self._score = PolicySearch(self._config, self._start), -np.inf
        if not self._is_choosing:
            self._search.restore(self._leader.state)
            self._score, self._leader = self._leader.score, None

    def save(self) -> None:
        """Make this state the run's checkpoint."""
        state = {**self._search.state(), "score": np.array(self._score)}
        if self._leader is not None:
            leader = {**self._leader.state, "score": np.array(self._leader.score)}
            state |= {f"leader_{name}": array for name, array in leader.items()}
        counters = {"num_timesteps": self.n_steps, "start": self._start}
        write_segment(self._checkpoints, self.history, counters, {STATE_FILE: safetensors_bytes(state)})
