"""Training many runs of one environment as one: collect, update, evaluate, checkpoint, segment by segment.

As in `pipelines/stages/train.py` a segment is the steps between two evaluations and starts with new environments and
random streams that the run and the segment alone decide. So a killed and resumed run equals an uninterrupted one, and a
run equals itself in whatever company it was trained, bit for bit on one type of processor with the same package
versions (between two types float32 rounds differently, and training multiplies the difference).
"""

import functools
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import otr
from pipelines.config import EnvConfig, FleetConfig, RunConfig
from pipelines.engine.store import actor_files
from pipelines.errors import ConfigError, PolicyMismatchError
from pipelines.play.environments import flat_state_size, is_discrete, make_env
from pipelines.play.rollout import Rollout, available_cores
from pipelines.play.selection import compare_with_trained, diverged, play_selection_episodes
from pipelines.training.checkpoints import progress_row
from pipelines.training.estimates import learning_starts, segment_steps
from pipelines.training.fleet.envpool_environments import EQUAL_IDS
from pipelines.training.fleet.fleet_run import FleetRun
from pipelines.training.fleet.progress import FleetProgress
from pipelines.training.fleet.random_streams import Draws, Streams
from pipelines.training.fleet.replay_buffer import FleetReplay, RowLayout
from pipelines.training.fleet.sac import FleetSac, Shapes
from pipelines.training.fleet.updates import Updates
from pipelines.training.fleet.vector_environments import Step, make_vector_env

torch.set_num_threads(1)  # two threads make these small networks a hundred times slower

Played = tuple[otr.ReluNetwork, Rollout]
PlayAll = Callable[[Sequence[otr.ReluNetwork], Sequence[RunConfig]], list[Played]]


def train(inputs: Mapping[str, Path], config: RunConfig, out: Path) -> None:
    """Train one run, and write the best actor, `evaluations.csv` and `progress.csv` into `out`.

    Raises:
        PipelineError: the training diverged.
        PolicyMismatchError: the exported network and the trained policy disagree on a visited state.
    """
    (error,) = train_fleet([config], [out])
    if error is not None:
        raise error


def train_fleet(configs: Sequence[RunConfig], outs: Sequence[Path]) -> list[Exception | None]:
    """Train runs as one, each from its own checkpoint, and write each one's result into its folder.

    Runs that are behind the others catch up first; a run that diverges is left behind.

    Args:
        configs: runs that `pipelines/training/fleet/groups.py` puts together.
        outs: an empty folder for each.

    Returns:
        For each run None, or why it has no result.
    """
    fleet = configs[0].fleet
    assert fleet is not None
    if fleet.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("trainer.device=cuda: torch sees no GPU here; use trainer.device=cpu")
    task = Task.of(configs[0])
    runs = [FleetRun(config, task.layout) for config in configs]
    with FleetProgress(runs) as progress, _player(fleet) as play:
        while cohort := _cohort(runs):
            with closing(FleetTrainer(task, cohort)) as trainer:
                while _cohort(runs) == cohort:
                    _segment(trainer, play, progress)
    for run, out in zip(runs, outs, strict=True):
        if run.error is None:
            run.history.write(out)
    return [run.error for run in runs]


def _cohort(runs: Sequence[FleetRun]) -> list[FleetRun]:
    """Return the runs that are to go on now: of those not finished and not given up, the ones furthest behind."""
    active = [run for run in runs if run.error is None and not run.is_finished]
    least = min((run.history.n_segments for run in active), default=0)
    return [run for run in active if run.history.n_segments == least]


def _segment(trainer: "FleetTrainer", play: PlayAll, progress: FleetProgress) -> None:
    """Train a cohort for one segment, evaluate its actors, and write its checkpoints."""
    start, began = trainer.runs[0].n_steps, time.monotonic()
    collected = trainer.train_segment(progress)
    trained_s = time.monotonic() - began
    for r, run in enumerate(trainer.runs):
        run.n_steps, run.n_updates = collected.end, trainer.n_updates
        run.tensors = trainer.tensors(r)
        if not all(bool(torch.isfinite(tensor).all()) for tensor in run.tensors.values()):
            run.error = diverged(run.n_steps, "its parameters are not finite")
            progress.given_up(run)
    going = [r for r, run in enumerate(trainer.runs) if run.error is None]
    networks = [trainer.network(r) for r in going]
    played = play(networks, [trainer.runs[r].config for r in going])
    for r, (network, episodes) in zip(going, played, strict=True):
        run = trainer.runs[r]
        try:
            compare_with_trained(network, functools.partial(trainer.answers, r), episodes.states, run.config)
        except PolicyMismatchError as error:
            run.error = error
            progress.given_up(run)
            continue
        # A run's seconds are its share of the fleet's, so that the runs' sum is what was spent.
        share = trained_s / len(trainer.runs)
        returns, lengths = np.array(collected.returns[r]), np.array(collected.lengths[r])
        row = progress_row(collected.end, start, share, returns, lengths)
        run.history.segment_done(row, actor_files(network), episodes)
        run.save()
        run.tracker.segment_done(row, run.history.evaluations[-1])
    progress.segment_done(trainer.runs, start, trained_s)


@dataclass(frozen=True)
class Task:
    """What the runs of a fleet have in common beyond their settings.

    Attributes:
        layout: of a transition.
        low, high: (n_actions,) float32, the box of actions.
    """

    layout: RowLayout
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, config: RunConfig) -> "Task":
        """Return the task of a run's environment; refuse labels as actions and states that are no vector."""
        env = make_env(config.env)
        try:
            if is_discrete(env):
                raise ConfigError(f"trainer={config.trainer.name} needs continuous actions; {config.env.id} has labels")
            box: Any = env.action_space
            return cls(RowLayout(flat_state_size(env), len(box.low)), box.low.ravel(), box.high.ravel())
        finally:
            env.close()


@dataclass
class Collected:
    """What a segment collected: the steps done since the run began, and each run's finished episodes."""

    end: int
    returns: list[list[float]]
    lengths: list[list[int]]


@contextmanager
def _flushed_denormals() -> Iterator[None]:
    """Take denormal numbers, which are slow, as zero for a while.

    Not for the whole process: what else it trains must not depend on whether this module was imported.
    """
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


class FleetTrainer:
    """A cohort of runs at the same step, stacked: trains a segment at a time, until it is closed.

    Args:
        task: of all of them.
        runs: in the order of their rows; their tensors are taken over.
        overlap: update while the environments step, on the transitions before that step; None for where the updates
            are done by another device than the environments' steps.
    """

    def __init__(self, task: Task, runs: Sequence[FleetRun], overlap: bool | None = None) -> None:
        self.runs, self._task = list(runs), task
        config = runs[0].config
        assert config.fleet is not None
        self._config, self._fleet = config, config.fleet
        self._device = torch.device(config.fleet.device)
        self._overlap = self._device.type != "cpu" if overlap is None else overlap
        algo, layout = runs[0].algo, task.layout
        shapes = Shapes(
            layout.n_inputs,
            layout.n_actions,
            config.hidden_widths,
            tuple(algo.critic),
            algo.batch_size,
            config.actor.negative_slope,
            algo.tau,
            config.fleet.precision,
        )
        self._learner = FleetSac(shapes, [run.settings for run in runs], self._device, runs[0].n_updates)
        for r, run in enumerate(runs):
            if run.tensors:
                self._learner.load(r, run.tensors)
            else:
                self._learner.initialise(r, run.initial_generator())
        self._replay = FleetReplay([run.rows for run in runs], layout, runs[0].buffer_size, self._device)
        self._updates = Updates(self._learner, self._replay)
        self._env = make_vector_env(  # each segment starts it anew
            config.env,
            len(runs) * config.fleet.n_envs,
            backend=backend(config.env, config.fleet),
            n_workers=1 if self._device.type == "cpu" else available_cores(),
            rescale_inputs=config.actor.rescale_inputs,
        )
        self._noise_std = torch.tensor(
            [run.algo.action_noise_std * (run.algo.action_noise == "normal") for run in runs], device=self._device
        ).view(-1, 1, 1)

    def close(self) -> None:
        """End the environments."""
        self._env.close()

    @property
    def n_updates(self) -> int:
        """Updates that each run has had."""
        return self._learner.n_updates

    def tensors(self, r: int) -> dict[str, Tensor]:
        """Return a copy of what a run has learnt, in the processor's memory."""
        return {name: tensor.cpu().clone() for name, tensor in self._learner.tensors(r).items()}

    def network(self, r: int) -> otr.ReluNetwork:
        """Return a run's actor."""
        tensors, n_actions = self.runs[r].tensors, self._task.layout.n_actions
        n_layers = len(self._config.hidden_widths) + 1
        weights = [tensors[f"actor.weight{i}"][0].T.double().numpy() for i in range(n_layers)]
        biases = [tensors[f"actor.bias{i}"][0, 0].double().numpy() for i in range(n_layers)]
        weights[-1], biases[-1] = weights[-1][:n_actions], biases[-1][:n_actions]  # the means
        slope, head = self._config.actor.negative_slope, otr.TanhBox(self._task.low, self._task.high)
        return otr.ReluNetwork(weights, biases, negative_slope=slope, head=head)

    def answers(self, r: int, states: np.ndarray) -> np.ndarray:
        """Return a run's own deterministic actions on states (n, d)."""
        on_device = torch.from_numpy(states).to(self._device)
        return self._unscale(self._learner.answers(r, on_device).cpu().numpy())

    @_flushed_denormals()
    @torch.no_grad()
    def train_segment(self, progress: FleetProgress) -> Collected:
        """Collect a segment's transitions and do its updates; the rows are on the disk afterwards."""
        config, n_runs, n_envs = self._config, len(self.runs), self._fleet.n_envs
        start, layout = self.runs[0].n_steps, self._task.layout
        n_steps = min(segment_steps(config), config.train.steps - start)
        n_vector_steps = -(-n_steps // n_envs)
        seeds = [run.seeds(1 + n_envs) for run in self.runs]
        streams = Streams(
            [own[0] for own in seeds], n_envs, self.runs[0].algo.batch_size, layout.n_actions, self._device
        )
        first_update = learning_starts(config)
        episodes = _Episodes(n_runs, n_envs)
        states = self._to_device(self._env.reset([seed for own in seeds for seed in own[1:]]))
        for t in range(n_vector_steps):
            ahead = t % streams.n_steps_ahead
            done = start + t * n_envs  # transitions of each run before this step
            sampled_to = done if self._overlap else done + n_envs
            if ahead == 0:
                draws = streams.draw()
                counts = sampled_to + n_envs * torch.arange(streams.n_steps_ahead, device=self._device)
                positions = self._replay.positions(draws.fractions, counts)
            scaled = self._act(states, draws, ahead, random=done < first_update)
            self._env.send(self._env_actions(scaled))
            if self._overlap and done > first_update:
                self._updates(positions[:, ahead], draws.updates[:, ahead])
            step = self._env.receive()
            parts = [states, scaled, *self._outcome(step)]
            self._replay.add(done, torch.cat(parts, dim=2))
            if not self._overlap and done + n_envs > first_update:
                self._updates(positions[:, ahead], draws.updates[:, ahead])
            states = self._to_device(step.states)
            episodes.add(step)
            progress.at_step(n_runs * (t + 1) * n_envs)
        end = start + n_vector_steps * n_envs
        self._replay.save(start, end)
        return Collected(end, episodes.returns, episodes.lengths)

    def _act(self, states: Tensor, draws: Draws, ahead: int, random: bool) -> Tensor:
        """Return actions in [-1, 1], (R, E, n_actions), as they go into the replay buffer."""
        scaled = draws.actions[:, ahead] if random else self._learner.act(states, draws.policy[:, ahead])
        return (scaled + self._noise_std * draws.exploration[:, ahead]).clamp_(-1.0, 1.0)

    def _env_actions(self, scaled: Tensor) -> np.ndarray:
        """Return what the environments take, (R E, n_actions); a run that has diverged must not upset its physics."""
        return self._unscale(np.nan_to_num(scaled.cpu().numpy(), nan=0.0)).reshape(-1, scaled.shape[2])

    def _unscale(self, actions: np.ndarray) -> np.ndarray:
        low, high = self._task.low, self._task.high
        unscaled: np.ndarray = low + 0.5 * (actions + 1.0) * (high - low)
        return unscaled

    def _outcome(self, step: Step) -> tuple[Tensor, Tensor, Tensor]:
        """Return next states, rewards and whether there is more to come, (R, E, .) each.

        An episode that ends by its time limit goes on as far as values are concerned.
        """
        continues = np.logical_not(step.terminated).astype(np.float32)
        arrays = (step.next_states, step.rewards[:, None].astype(np.float32), continues[:, None])
        next_states, rewards, continuing = (self._to_device(array) for array in arrays)
        return next_states, rewards, continuing

    def _to_device(self, array: np.ndarray) -> Tensor:
        """Return (R E, k) numbers as (R, E, k) on the device."""
        tensor = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)).to(self._device, non_blocking=True)
        return tensor.view(len(self.runs), self._fleet.n_envs, -1)


class _Episodes:
    """Returns and lengths of the episodes that end, by run."""

    def __init__(self, n_runs: int, n_envs: int) -> None:
        self.returns: list[list[float]] = [[] for _ in range(n_runs)]
        self.lengths: list[list[int]] = [[] for _ in range(n_runs)]
        self._n_envs = n_envs
        self._return = np.zeros(n_runs * n_envs)
        self._length = np.zeros(n_runs * n_envs, dtype=np.int64)

    def add(self, step: Step) -> None:
        """Take in a step of all environments."""
        self._return += step.rewards
        self._length += 1
        for i in np.flatnonzero(step.terminated | step.truncated):
            self.returns[i // self._n_envs].append(float(self._return[i]))
            self.lengths[i // self._n_envs].append(int(self._length[i]))
            self._return[i], self._length[i] = 0.0, 0


def backend(env: EnvConfig, fleet: FleetConfig) -> str:
    """Return who steps an environment: EnvPool where it is asked for and computes what gymnasium does."""
    return fleet.environments if env.id in EQUAL_IDS else "gymnasium"


@contextmanager
def _player(fleet: FleetConfig) -> Iterator[PlayAll]:
    """Give the function that plays all runs' selection episodes: here, or beside a GPU in a process a core."""
    if fleet.device == "cpu":
        yield _play_here
        return
    with ProcessPoolExecutor(available_cores(), multiprocessing.get_context("spawn")) as pool:
        yield lambda networks, configs: list(pool.map(play_selection_episodes, networks, configs))


def _play_here(networks: Sequence[otr.ReluNetwork], configs: Sequence[RunConfig]) -> list[Played]:
    return [play_selection_episodes(network, config) for network, config in zip(networks, configs, strict=True)]
