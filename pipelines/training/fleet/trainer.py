"""A cohort of runs at the same step, stacked: collects transitions and updates, a segment at a time."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

import otr
from otr.control.sac.actors import FleetActors, ModuleActors
from otr.control.sac.autoreset import Autoreset, Step
from otr.control.sac.random_streams import Draws, Streams
from otr.control.sac.replay_buffer import FleetReplay, RowLayout
from otr.control.sac.sac import FleetSac, Shapes
from otr.importers.critics import Critics
from otr.learners.networks.denormals import denormals_as_zero
from pipelines.config.hardened_methods import ExpertsConfig, SoftConfig
from pipelines.errors import ConfigError
from pipelines.play.environments import flat_state_size, is_discrete, make_env
from pipelines.play.episodes import Rollout
from pipelines.play.selection import evaluate_network, units_of_box
from pipelines.play.vector_envs import make_vector_env
from pipelines.training.estimates import learning_starts, segment_steps
from pipelines.training.experts_actor import ExpertsActor
from pipelines.training.fleet.fleet_run import FleetRun
from pipelines.training.fleet.progress import FleetProgress
from pipelines.training.fleet.soft_actors import SoftActors, SoftTraining
from pipelines.training.settings import TrainSettings
from pipelines.training.soft_trees import HardeningModule, evaluate_hardened, shape_of

Given = TypeVar("Given")
Answer = TypeVar("Answer")
torch.set_num_threads(1)  # two threads make these small networks a hundred times slower


@dataclass(frozen=True)
class Task:
    """What the runs of a fleet share beyond their settings."""

    layout: RowLayout  # of a transition
    low: np.ndarray  # (n_actions,) float32, the box of actions
    high: np.ndarray

    @classmethod
    def of(cls, config: TrainSettings) -> "Task":
        """Return the task of a run's environment; refuse labels as actions and states that are no vector."""
        env = make_env(config.env)
        try:
            if is_discrete(env):
                name = config.fleet.name if config.fleet else "fleet"
                raise ConfigError(f"trainer={name} needs continuous actions; {config.env.id} has labels")
            box: Any = env.action_space
            return cls(RowLayout(flat_state_size(env), len(box.low)), box.low.ravel(), box.high.ravel())
        finally:
            env.close()


class EnvironmentFailed(Exception):
    """An environment raised an error, the cause, in a segment; of several runs it is not known which."""


class FleetTrainer:
    """Trains a cohort of runs of a task at the same step, until it is closed; takes their tensors over."""

    def __init__(self, task: Task, runs: Sequence[FleetRun]) -> None:
        self.runs, self._task = list(runs), task
        config = runs[0].config
        assert config.fleet is not None
        self._config, self._n_envs = config, config.fleet.n_envs
        algo, layout = runs[0].algo, task.layout
        shapes = Shapes(
            layout.n_inputs,
            layout.n_actions,
            config.hidden_widths,
            tuple(algo.critic),
            algo.batch_size,
            config.actor.negative_slope,
            algo.tau,
            bool(config.actor.links),
            actor_delay=algo.actor_delay,
        )
        settings, generators = [run.settings for run in runs], [run.initial_generator() for run in runs]
        actor: FleetActors | None = None
        numbers = layout.n_inputs, layout.n_actions
        if isinstance(config.method, ExpertsConfig):
            shape = *numbers, config.depth, config.method.balance
            actor = ModuleActors(settings, [ExpertsActor(*shape, generator) for generator in generators])
        elif isinstance(config.method, SoftConfig):
            training = SoftTraining(shape_of(config), config.method, config.train.steps)
            actor = SoftActors(settings, training, *numbers, algo.batch_size)
        self._learner = FleetSac(shapes, settings, runs[0].n_updates, actor)
        for r, run in enumerate(runs):
            if run.tensors:
                self._learner.load(r, run.tensors)
            else:
                self._learner.initialise(r, generators[r])
        self._replay = FleetReplay([run.rows for run in runs], layout, runs[0].buffer_size)
        envs = make_vector_env(config.env, "gymnasium", rescale_inputs=config.actor.rescale_inputs)
        self._env = Autoreset(envs)  # each segment restarts them
        noise_std = [run.algo.action_noise_std * (run.algo.action_noise == "normal") for run in runs]
        self._noise_std = torch.tensor(noise_std).view(-1, 1, 1)

    def close(self) -> None:
        """End the environments."""
        self._env.close()

    @property
    def n_updates(self) -> int:
        """Updates that each run has had."""
        return self._learner.n_updates

    def tensors(self, r: int) -> dict[str, Tensor]:
        """Return a copy of what a run has learnt."""
        return {name: tensor.clone() for name, tensor in self._learner.tensors(r).items()}

    def evaluate(self, r: int) -> tuple[dict[str, bytes], Rollout]:
        """Return the files of a run's finished actor, and the results of its selection episodes.

        Raises:
            PolicyMismatchError: the exported network and the trained actor disagree on a visited state.
        """
        config, task = self.runs[r].config, self._task
        units = units_of_box(config.env, config.actor.rescale_inputs)
        module = self._hardening(r)
        if module is not None:
            return evaluate_hardened(module, config, gym.spaces.Box(task.low, task.high), units)
        return evaluate_network(self.network(r), functools.partial(self.answers, r), config, units)

    def _hardening(self, r: int) -> HardeningModule | None:
        """Return the module that becomes a run's tree; None of a network."""
        actor = self._learner.actor
        if isinstance(actor, SoftActors):
            return actor.trees[r]
        module = actor.modules[r] if isinstance(actor, ModuleActors) else None
        return module.mean if isinstance(module, ExpertsActor) else None

    def network(self, r: int) -> otr.ReluNetwork:
        """Return a run's actor."""
        both, n_actions = self._means_and_deviations(r), self._task.layout.n_actions
        weights = [*both.weights[:-1], both.weights[-1][:n_actions]]
        biases = [*both.biases[:-1], both.biases[-1][:n_actions]]
        return both.replace(weights=weights, biases=biases, head=otr.TanhBox(self._task.low, self._task.high))

    def critics(self, r: int) -> Critics:
        """Return a run's critics, as they read the environment's own states."""
        tensors, algo = self.runs[r].tensors, self.runs[r].algo
        n_layers = len(algo.critic) + 1
        layers, targets = (
            [(tensors[f"{name}.weight{i}"].numpy(), tensors[f"{name}.bias{i}"].numpy()) for i in range(n_layers)]
            for name in ("critics", "targets")
        )
        temperature, config = float(tensors["log_temperature"]), self._config
        units = units_of_box(config.env, config.actor.rescale_inputs)
        critics = Critics(layers, targets, algo.gamma, config.actor.negative_slope, temperature)
        if units is not None:
            critics = critics.fold_input_normalisation(units.middle, units.scale)
        if self._hardening(r) is not None:
            return critics  # whose actor is played as the tree that it becomes
        both, n_actions = self._means_and_deviations(r), self._task.layout.n_actions
        if units is not None:
            both = both.fold_input_normalisation(units.middle, units.scale)
        log_std = np.column_stack((both.weights[-1], both.biases[-1]))[n_actions:]
        return dataclasses.replace(critics, log_std=log_std)

    def _means_and_deviations(self, r: int) -> otr.ReluNetwork:
        """Return a run's actor with all its outputs: means, then logarithms of standard deviations."""
        tensors, actor = self.runs[r].tensors, self._config.actor
        layers = range(len(self._config.hidden_widths) + 1)
        weights = [tensors[f"actor.weight{i}"][0].T.double().numpy() for i in layers]
        biases = [tensors[f"actor.bias{i}"][0, 0].double().numpy() for i in layers]
        return otr.ReluNetwork(weights, biases, negative_slope=actor.negative_slope, dense=actor.links)

    def answers(self, r: int, states: np.ndarray) -> np.ndarray:
        """Return a run's own deterministic actions on states (n, d)."""
        return self._unscale(self._learner.answers(r, torch.from_numpy(states)).numpy())

    @torch.no_grad()
    def train_segment(self, progress: FleetProgress) -> tuple[int, list[list[float]], list[list[int]]]:
        """Collect a segment's transitions and do its updates; the rows are on the disk afterwards.

        Returns:
            The steps done since the run began, and the returns and lengths of each run's finished episodes.

        Raises:
            EnvironmentFailed: an environment raised something; each run is as its last segment left it.
        """
        with denormals_as_zero():
            config, n_runs, n_envs = self._config, len(self.runs), self._n_envs
            start, n_actions = self.runs[0].n_steps, self._task.layout.n_actions
            n_steps = min(segment_steps(config), config.train.steps - start)
            n_vector_steps = -(-n_steps // n_envs)
            seeds = [run.seeds(1 + n_envs) for run in self.runs]
            streams = Streams([own[0] for own in seeds], n_envs, self.runs[0].algo.batch_size, n_actions)
            first_update = learning_starts(config)
            episodes = _EpisodeSums(n_runs, n_envs)
            states = self._by_run(self._asked(self._env.reset, [seed for own in seeds for seed in own[1:]]))
            for t in range(n_vector_steps):
                ahead = t % streams.n_steps_ahead
                done = start + t * n_envs  # transitions of each run before this step
                if ahead == 0:
                    n_updates, counts = self._updates(done, streams.n_steps_ahead)
                    draws, next_update = streams.draw(len(counts)), 0
                    positions = self._replay.positions(draws.fractions, counts)
                scaled = self._act(states, draws, ahead, random=done < first_update)
                step = self._asked(self._env.step, self._env_actions(scaled))
                self._replay.add(done, torch.cat([states, scaled, *self._outcome(step)], dim=2))
                updates = range(next_update, next_update := next_update + n_updates[ahead])
                if done + n_envs > first_update:
                    self._learner.at_step(done, self._rate_share(done))
                    for u in updates:
                        self._learner.update(self._replay.gather(positions[:, u]), draws.updates[:, u])
                states = self._by_run(step.states)
                episodes.add(step)
                progress.at_more_steps(n_runs * (t + 1) * n_envs)
            self._replay.flush()
            return start + n_vector_steps * n_envs, episodes.returns, episodes.lengths

    def _updates(self, done: int, n_vector_steps: int) -> tuple[list[int], Tensor]:
        """Return how many updates follow each vector step after `done` transitions, and each one's transitions (U,).

        `gradient_steps` updates follow every `train_freq`-th transition of the run, wherever its segments begin.
        """
        algo, n_envs = self.runs[0].algo, self._n_envs
        ends = done + n_envs * (1 + torch.arange(n_vector_steps))
        n_updates = algo.gradient_steps * (ends // algo.train_freq - (ends - n_envs) // algo.train_freq)
        return n_updates.tolist(), ends.repeat_interleave(n_updates)

    def _rate_share(self, done: int) -> float:
        """Return the share of the learning rates after `done` steps, which falls linearly to the end's."""
        return 1.0 - (1.0 - self.runs[0].algo.learning_rate_end) * done / self._config.train.steps

    @staticmethod
    def _asked(call: Callable[[Given], Answer], argument: Given) -> Answer:
        """Return what the environments answer."""
        try:
            return call(argument)
        except Exception as error:  # foreign code can fail in any way
            raise EnvironmentFailed from error

    def _act(self, states: Tensor, draws: Draws, ahead: int, random: bool) -> Tensor:
        """Return actions in [-1, 1], (R, E, n_actions), as they go into the replay buffer."""
        scaled = draws.actions[:, ahead] if random else self._learner.act(states, draws.policy[:, ahead])
        return (scaled + self._noise_std * draws.exploration[:, ahead]).clamp_(-1.0, 1.0)

    def _env_actions(self, scaled: Tensor) -> np.ndarray:
        """Return what the environments take, (R E, n_actions); a run that has diverged must not upset its physics."""
        return self._unscale(np.nan_to_num(scaled.numpy(), nan=0.0)).reshape(-1, scaled.shape[2])

    def _unscale(self, actions: np.ndarray) -> np.ndarray:
        low, high = self._task.low, self._task.high
        unscaled: np.ndarray = low + 0.5 * (actions + 1.0) * (high - low)
        return unscaled

    def _outcome(self, step: Step) -> tuple[Tensor, Tensor, Tensor]:
        """Return next states, rewards and whether there is more to come, (R, E, .) each.

        For values, an episode that ends by its time limit continues.
        """
        continues = np.logical_not(step.terminated).astype(np.float32)
        return self._by_run(step.next_states), self._by_run(step.rewards), self._by_run(continues)

    def _by_run(self, array: np.ndarray) -> Tensor:
        """Return (R E,) or (R E, k) numbers as (R, E, k)."""
        rows = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
        return rows.view(len(self.runs), self._n_envs, -1)


class _EpisodeSums:
    """Returns and lengths of the episodes that end, by run."""

    def __init__(self, n_runs: int, n_envs: int) -> None:
        self.returns: list[list[float]] = [[] for _ in range(n_runs)]
        self.lengths: list[list[int]] = [[] for _ in range(n_runs)]
        self._n_envs = n_envs
        self._return = np.zeros(n_runs * n_envs)
        self._length = np.zeros(n_runs * n_envs, dtype=np.int64)

    def add(self, step: Step) -> None:
        """Record a step of all environments."""
        self._return += step.rewards
        self._length += 1
        for i in np.flatnonzero(step.terminated | step.truncated):
            self.returns[i // self._n_envs].append(float(self._return[i]))
            self.lengths[i // self._n_envs].append(int(self._length[i]))
            self._return[i], self._length[i] = 0.0, 0
