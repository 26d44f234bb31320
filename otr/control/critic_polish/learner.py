"""The soft actor-critic of one finished policy, on the critics of the actor that it was made from.

Critics, targets and temperature are taken over, Adam's moments are not. The replay buffer is not kept either: the
oracle's stochastic play fills a new one in seconds, of which the policy itself may act in a share, as in DAgger.

A few neurons often settle in a slow gait, many rarely. So a small network is widened first, and narrowed as it learns.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from otr.control.critic_polish.neurons import can_widen, narrowed, widened
from otr.control.critic_polish.policy_actor import OraclePlay, PolicyActor, check_critics, is_clipped
from otr.control.environments import VectorEnv
from otr.control.sac.actors import ModuleActors
from otr.control.sac.adam import RunSettings
from otr.control.sac.autoreset import Autoreset
from otr.control.sac.mlp import Layers
from otr.control.sac.random_streams import Streams
from otr.control.sac.replay_buffer import FleetReplay, RowLayout
from otr.control.sac.sac import N_CRITICS, FleetSac, Shapes
from otr.control.search.policy_numbers import Policy, policy_numbers
from otr.control.search.polish import SETTINGS, Episodes, Evaluate, PolishReport, best_confirmed
from otr.control.settings import CriticPolishSettings, PolishSettings
from otr.control.soft_trees.policy_module import policy_module
from otr.core.network import ReluNetwork
from otr.core.smooth_network import Layered, Oracle
from otr.core.tree import ObliqueTree
from otr.importers.critics import Critics
from otr.learners.networks.denormals import denormals_as_zero
from otr.setting import check_settings

TEMPERATURE = 0.05  # at first, of critics that came without one (TD3, DDPG)
NARROWING = (0.2, 0.6)  # of the steps, between which a widened network loses neurons
N_LATEST = 5_000  # states that say which
LEARNING_RATE_END = 0.1  # of a widened network's learning rates, to which they fall linearly
LEARNING = CriticPolishSettings()

Act = Callable[[Tensor, Tensor], Tensor]  # from states (1, 1, d) and normal noise (1, 1, n_actions) to actions


def polish_by_critics(
    policy: Policy,
    evaluate: Evaluate,
    envs: VectorEnv,
    critics: Critics,
    oracle: Oracle | None,
    *,
    seeds: Sequence[int],
    settings: CriticPolishSettings = LEARNING,
    n_selection_episodes: int = SETTINGS.n_selection_episodes,
    n_candidates: int = SETTINGS.n_candidates,
    free: bool = SETTINGS.free,
    tied: bool = False,
    seed: int = 0,
    learns_first: bool = False,
    report: Callable[[PolishReport], None] | None = None,
    say: Callable[[str], None] = print,
) -> Policy:
    """Return a policy of the same shape that earns more, or the policy itself: `otr.polish` by critics, not by search.

    Args:
        policy: a tree or a network whose actions tanh or a clip leads into their box.
        envs: of which one is played in to learn.
        critics: of the actor that the policy was made from.
        oracle: that actor; None where it is no network: the policy itself then fills the replay buffer.
        seeds: (3,), of the play that fills the replay buffer, of the learning, and of its environment.
        settings: of the learning.
        learns_first: whether candidates play once all have learnt, as where `evaluate` plays in `envs`, too.
        evaluate, n_selection_episodes, n_candidates, free, tied, seed, report: as in `otr.polish`.
        say: called with the progress until candidates play, and where numbers that are not finite end the learning.

    Raises:
        TypeError, ValueError: as `check_critics`, or a setting is out of range.
    """
    for each in (settings, PolishSettings(n_selection_episodes=n_selection_episodes, n_candidates=n_candidates)):
        check_settings(each)
    check_critics(critics, policy)
    numbers = policy_numbers(policy, np.zeros((1, policy.n_inputs)), free=free, tied=tied)
    start = PolishReport(numbers.start.size, settings.steps, 0, ())
    learning = CriticPolish(policy, envs, critics, oracle, settings, seeds, free=free, tied=tied)
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)  # two threads make these small networks a hundred times slower
    try:
        found = learning.candidates(n_candidates, say)
        play, found = Episodes(evaluate, seed), iter(list(found)) if learns_first else found
        best: Policy = best_confirmed(policy, found, play, start, n_selection_episodes, report)
        return best
    finally:
        torch.set_num_threads(n_threads)


class CriticPolish:
    """Learns on a policy's numbers, one update a step; `candidates` yields the results."""

    def __init__(
        self,
        policy: ObliqueTree | ReluNetwork,
        envs: VectorEnv,
        critics: Critics,
        oracle: Oracle | None,
        settings: CriticPolishSettings,
        seeds: Sequence[int],
        *,
        free: bool,
        tied: bool,
    ) -> None:
        """Keep what is polished, as `polish_by_critics` takes it."""
        self._policy, self._critics, self._settings = policy, critics, settings
        self._free, self._tied = free, tied
        self._oracle = OraclePlay(oracle, critics) if isinstance(oracle, Layered) else None
        self._seeds, self._env = seeds, Autoreset(envs)
        limits = policy.head.limits(policy.n_outputs)
        assert limits is not None
        self._low, self._high = limits
        self._is_widened = can_widen(policy, settings.first_neurons, free=free)
        self._layout = RowLayout(policy.n_inputs, len(self._low))
        rows = np.zeros((settings.refill_steps + settings.steps, self._layout.width), dtype=np.float32)
        self._replay = FleetReplay([rows], self._layout, len(rows))
        self._n_rows, self._states = 0, torch.zeros(1, 1, policy.n_inputs)
        self._discounted, self._highest = 0.0, -math.inf  # rewards of the episode up to now, and the most that were met

    def candidates(self, n: int, say: Callable[[str], None]) -> Iterator[tuple[int, Any]]:
        """Fill the replay buffer and learn; yield steps and policy at n regular steps, the last one among them."""
        settings, learner = self._settings, self._filled()
        widths = self._widths()  # by the step from which they hold
        first = max(widths, default=0)  # as wide as the policy from then on
        chosen = np.linspace(first, settings.steps, n + 1).round().astype(int).tolist()
        rates = np.interp(np.arange(settings.steps), [first, settings.steps], [1, LEARNING_RATE_END if widths else 1])
        streams = Streams(self._seeds[1:2], 1, settings.batch_size, self._layout.n_actions)
        self._restart(self._seeds[2])
        for start, end in itertools.pairwise(sorted({0, *widths, *chosen})):
            if start in widths:
                self._narrow(learner, widths[start])
            with denormals_as_zero(), torch.no_grad():
                for t in range(start, end):
                    ahead = t % streams.n_steps_ahead
                    if ahead == 0:
                        draws = streams.draw(streams.n_steps_ahead)
                        counts = settings.refill_steps + t + 1 + torch.arange(streams.n_steps_ahead)
                        positions = self._replay.positions(draws.fractions, counts)
                    self._step(learner.act, draws.policy[:, ahead], settings.noise * draws.exploration[:, ahead])
                    learner.at_step(t, rates[t])
                    if settings.bounds_values:
                        learner.highest_value.fill_(self._highest)
                    learner.update(self._replay.gather(positions[:, ahead]), draws.updates[:, ahead])
            if not all(bool(torch.isfinite(each).all()) for each in learner.tensors(0).values()):
                say(f"numbers are no longer finite after {end:,} steps, which ends the polish")
                return
            if end in chosen and end > first:
                yield end, self._actor.policy.policy()
            elif 10 * end // settings.steps > 10 * start // settings.steps:
                n_neurons = cast(ReluNetwork, self._actor.policy.policy()).n_hidden
                say(f"{end:,} of {settings.steps:,} steps, {n_neurons} neurons")

    def _filled(self) -> FleetSac:
        """Fill the replay buffer, and return the learner; the policy's part of it comes last."""
        settings, generator = self._settings, torch.Generator().manual_seed(self._seeds[0])
        n_own = settings.refill_steps if self._oracle is None else round(
            settings.student_share * settings.refill_steps
        )  # fmt: skip
        self._restart(self._seeds[0])
        oracle = self._oracle

        def play(act: Act, n_steps: int) -> None:
            for _ in range(n_steps):
                noise = torch.randn(2, 1, 1, self._layout.n_actions, generator=generator)
                self._step(act, noise[0], settings.refill_noise * noise[1])

        if oracle is not None:
            play(
                lambda states, noise: torch.from_numpy(oracle.act(states[0].double().numpy(), noise[0].numpy()))[None],
                settings.refill_steps - n_own,
            )
        else:  # the units of the policy's inputs are those of what it meets
            play(lambda states, noise: self._original(states), min(n_own, 1_000))
        learner = self._learner(self._replay_states())
        with torch.no_grad():
            play(learner.act, settings.refill_steps - self._n_rows)
        return learner

    def _learner(self, states: np.ndarray) -> FleetSac:
        """Return the learner of a policy that reads what states (n, d) have visited."""
        settings, critics = self._settings, self._critics
        log_stds = None if self._oracle is None else self._oracle.log_stds(states)
        policy = self._policy
        if self._is_widened:
            rng = np.random.default_rng(self._seeds[1])
            policy = widened(cast(ReluNetwork, policy), settings.first_neurons, states, rng)
        self._actor = PolicyActor(policy, states, log_stds, free=self._free, tied=self._tied)
        runs = [RunSettings(settings.learning_rate, critics.gamma)]
        shapes = Shapes(
            self._layout.n_inputs, self._layout.n_actions, (), critics.widths, settings.batch_size,
            critics.negative_slope, clips=is_clipped(self._policy.head),
        )  # fmt: skip
        learner = FleetSac(shapes, runs, actor=ModuleActors(runs, [self._actor]))
        for ours, theirs in ((learner.critics, critics.layers), (learner.targets, critics.targets)):
            _take_over(ours, theirs)
        given = critics.log_temperature
        learner.log_temperature[0] = np.log(TEMPERATURE) if given is None else given
        return learner

    def _widths(self) -> dict[int, int]:
        """Return, by step, to how many neurons a widened network is narrowed there; the last ones take longest."""
        if not self._is_widened:
            return {}
        settings, (n_own,) = self._settings, cast(ReluNetwork, self._policy).hidden_widths
        widths = np.arange(settings.first_neurons, n_own - 1, -1)
        done = (1 / widths - 1 / widths[0]) / (1 / n_own - 1 / widths[0])
        begin, end = NARROWING
        steps = ((begin + (end - begin) * done) * settings.steps).round().astype(int)
        return dict(zip(steps[1:].tolist(), widths[1:].tolist(), strict=True))

    def _narrow(self, learner: FleetSac, n_neurons: int) -> None:
        """Go on with fewer neurons, those that the others can do least without in the latest states."""
        states = self._replay_states()[-N_LATEST:]
        policy = narrowed(cast(ReluNetwork, self._actor.policy.policy()), n_neurons, states)
        self._actor.policy = policy_module(policy, states, free=self._free)
        learner.actor = ModuleActors(learner.runs, [self._actor])

    def _replay_states(self) -> np.ndarray:
        """Return the states in the replay buffer, (n, d)."""
        positions = torch.arange(self._n_rows).unsqueeze(0)
        return self._replay.gather(positions).states[0].double().numpy()

    def _restart(self, seed: int) -> None:
        self._discounted = 0.0
        self._states = torch.from_numpy(self._env.reset([seed])).view(1, 1, -1)

    def _original(self, states: Tensor) -> Tensor:
        """Return the original policy's actions in [-1, 1]."""
        answers = self._policy.predict(states[0].double().numpy())
        return torch.from_numpy((2 * answers - self._low - self._high) / (self._high - self._low)).unsqueeze(0)

    def _step(self, act: Act, noise: Tensor, exploration: Tensor) -> None:
        """Do a step of the environment, and keep it in the replay buffer."""
        scaled = (act(self._states, noise).float() + exploration).clamp_(-1.0, 1.0)
        actions = self._low + 0.5 * (np.nan_to_num(scaled[0].numpy(), nan=0.0) + 1.0) * (self._high - self._low)
        step = self._env.step(actions.astype(np.float32))
        outcome = (step.next_states, step.rewards, np.logical_not(step.terminated).astype(np.float32))
        parts = (torch.from_numpy(np.ascontiguousarray(each)).view(1, 1, -1) for each in outcome)
        self._replay.add(self._n_rows, torch.cat([self._states, scaled, *parts], dim=2))
        self._n_rows += 1
        self._states = torch.from_numpy(step.states).view(1, 1, -1)
        self._discounted = self._critics.gamma * self._discounted + float(step.rewards[0])
        self._highest = max(self._highest, self._discounted)
        if step.terminated[0] or step.truncated[0]:
            self._discounted = 0.0


def _take_over(ours: Layers, theirs: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """Write critics into a stack, the first two of several; DDPG's only one fills both."""
    for weight, bias, (their_weight, their_bias) in zip(ours.weights, ours.biases, theirs, strict=True):
        for stack, given in ((weight, their_weight), (bias, their_bias)):
            stack.copy_(torch.from_numpy(np.array(given[:N_CRITICS])).expand(N_CRITICS, -1, -1))
