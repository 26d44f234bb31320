"""Polish: direct search on the return over the numbers of a finished policy, whose structure stays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from otr.control.search.direct_search import DirectSearch
from otr.control.search.policy_numbers import Policy, PolicyNumbers, policy_numbers
from otr.control.search.sensitivity import sensitivity_scale
from otr.control.settings import PolishSettings, SearchSettings
from otr.core.arrays import FloatArray, IntArray
from otr.setting import check_settings

# From k policies and the seeds (k, m) of their episodes to the episodes' returns (k, m).
Evaluate = Callable[[Sequence[Any], IntArray], ArrayLike]

SETTINGS = PolishSettings()
# Where the seeds of episodes begin, and what they stay below; those below 2**20 are for reports.
SEARCH_SEEDS = (2**20, 2**30)
SELECTION_SEEDS = (2**30, 2**30 + 2**29)
CONFIRMATION_SEEDS = (2**30 + 2**29, 2**31)
# Of a scale by sensitivity: what it is multiplied by at first, halved up to so many times until the median of the first
# vectors loses less than that share of the return
FIRST_SIZE, MOST_HALVINGS, MOST_LOST = 8.0, 12, 0.05


@dataclass(frozen=True)
class PolishReport:
    """The progress of a polish.

    Attributes:
        n_numbers: how many are searched.
        n_iterations: of the search, in all.
        n_played: episodes so far, those of selection and confirmation included.
        candidates: iteration and mean return on the selection episodes of each; iteration 0 is the original.
        confirmation: mean returns of the original and of the best candidate on the confirmation episodes; None before
            these are played, and where no candidate is better than the original on the selection episodes.
        kept: whether the best candidate is the polished policy, at the end.
        size: what a scale by sensitivity is multiplied by, so that vectors lose little.
    """

    n_numbers: int
    n_iterations: int
    n_played: int
    candidates: tuple[tuple[int, float], ...]
    confirmation: tuple[float, float] | None = None
    kept: bool = False
    size: float = 1.0


def polish(
    policy: Policy,
    evaluate: Evaluate,
    *,
    states: ArrayLike,
    n_iterations: int = 100,
    settings: SearchSettings = SETTINGS,
    scale: str = SETTINGS.scale,
    n_episodes: int = SETTINGS.n_episodes,
    common_starts: str = SETTINGS.common_starts,
    n_selection_episodes: int = SETTINGS.n_selection_episodes,
    n_candidates: int = SETTINGS.n_candidates,
    free: bool = SETTINGS.free,
    tied: bool = False,
    seed: int = 0,
    report: Callable[[PolishReport], None] | None = None,
) -> Policy:
    """Return a policy of the same shape with a better return, or the policy itself where none was found.

    Augmented random search (Mania, Guy & Recht 2018) over the numbers of tests and leaves, or of a network's layers, in
    the units of `otr.control.search.policy_numbers`. Candidates along the way play the selection episodes; the best of
    them is kept if it earns more than the original on as many confirmation episodes, on average and by more than one
    standard error of the paired differences. No episode serves two purposes.

    Args:
        policy: an ObliqueTree or a ReluNetwork.
        evaluate: from k policies and seeds (k, m) to returns (k, m); the same seed has to mean the same start, so that
            returns are compared on common random numbers. All seeds are at least 2**20 and below 2**31.
        states: (n, d) states that the policy visits.
        n_iterations: of the search, each of ``2 * settings.n_directions * n_episodes`` episodes.
        settings: of the search; step and noise are in units of a row's size, times the scale.
        scale: of all numbers 1, or by sensitivity: smaller where the actions react more
            (`otr.control.search.sensitivity`), of a size that is found: the largest of 8, 4, 2 and so on at which
            the median of the first vectors loses less than 5 % of the return.
        n_episodes, common_starts, n_selection_episodes, n_candidates, free: see `otr.control.settings.PolishSettings`.
        tied: whether a tree's tests that are equal, and its leaves that are, stay equal.
        seed: of directions and episodes.
        report: called after every candidate, and at the end.

    Raises:
        TypeError: the policy is neither a tree nor a network.
        ValueError: a number is out of range, the states are not the policy's, returns are not (k, m) finite numbers, or
            sensitivities are asked of labels.

    Examples:
        >>> tree = otr.parse_program("x + 1", ["x"])
        >>> def returns(policies, seeds):  # of every policy in episodes that begin from seeds
        ...     return [[-((p.predict([1.0])[0] - 3.0) ** 2)] * seeds.shape[1] for p in policies]
        >>> better = otr.polish(tree, returns, states=[[0.0], [1.0]], n_iterations=30)
        >>> better.predict([1.0]).round(1)
        array([3.])
    """
    if n_iterations < 1:
        raise ValueError(f"n_iterations={n_iterations} is not at least 1")
    check_settings(
        PolishSettings(
            scale=scale, n_episodes=n_episodes, common_starts=common_starts,
            n_selection_episodes=n_selection_episodes, n_candidates=n_candidates,
        )
    )  # fmt: skip
    numbers = policy_numbers(policy, states, free=free, tied=tied)
    play = Episodes(evaluate, seed, n_episodes, shared_by_all=common_starts == "all")
    search, size = DirectSearch(numbers.start, settings, seed), 1.0
    if scale == "sensitivity":
        search, size = _bearable(numbers, play, settings, seed, sensitivity_scale(numbers, states))
    candidates = _candidates(numbers, play, search, n_iterations, n_candidates)
    start = PolishReport(numbers.start.size, n_iterations, 0, (), size=size)
    return best_confirmed(policy, candidates, play, start, n_selection_episodes, report)


def best_confirmed(
    policy: Policy,
    candidates: Iterable[tuple[int, Policy]],
    play: Episodes,
    start: PolishReport,
    n_selection_episodes: int,
    report: Callable[[PolishReport], None] | None = None,
) -> Policy:
    """Return the best of a policy's successors where it is confirmed, else the policy: the last step of every polish.

    Args:
        policy: the original.
        candidates: iteration and policy of each successor; the next one is asked for once the last has played.
        play: the episodes.
        start: what is reported before the first candidate.
        n_selection_episodes, report: as in `polish`.
    """
    account = _Account(start, play, report)
    select = play.fixed(SELECTION_SEEDS, n_selection_episodes)
    best, best_mean = policy, float(play([policy], select).mean())
    account.add_candidate(0, best_mean)
    for iteration, candidate in candidates:
        mean = float(play([candidate], select).mean())
        account.add_candidate(iteration, mean)
        if mean > best_mean:
            best, best_mean = candidate, mean
    if best is policy:
        account.finish(None, kept=False)
        return policy
    before, after = play([policy, best], play.fixed(CONFIRMATION_SEEDS, n_selection_episodes))
    gains = after - before
    error = gains.std(ddof=1) / math.sqrt(len(gains)) if len(gains) > 1 else 0.0
    kept = bool(gains.mean() > error)
    account.finish((float(before.mean()), float(after.mean())), kept=kept)
    return best if kept else policy


def _candidates(
    numbers: PolicyNumbers[Policy],
    play: Episodes,
    search: DirectSearch,
    n_iterations: int,
    n_candidates: int,
) -> Iterator[tuple[int, Policy]]:
    """Search, and yield iteration and policy of the iterates that are candidates."""
    if not numbers.start.size:
        return
    chosen = set(np.linspace(0, n_iterations, n_candidates + 1).round().astype(int).tolist())
    for iteration in range(1, n_iterations + 1):
        vectors = search.ask((iteration - 1) / n_iterations)
        returns = play([numbers.policy(vector) for vector in vectors], play.of_iteration(iteration, len(vectors)))
        search.tell(returns.mean(axis=1))
        if iteration in chosen:
            yield iteration, numbers.policy(search.centre)


def _bearable(
    numbers: PolicyNumbers[Policy], play: Episodes, settings: SearchSettings, seed: int, scale: FloatArray
) -> tuple[DirectSearch, float]:
    """Return the search of the largest size at which the median of the first vectors loses little, and the size."""
    starts = play.of_iteration(0, 2 * settings.n_directions)
    before = play([numbers.policy(numbers.start)], starts.reshape(1, -1)).reshape(starts.shape)
    for size in FIRST_SIZE / 2.0 ** np.arange(MOST_HALVINGS + 1):
        search = DirectSearch(numbers.start, settings, seed, size * scale)
        returns = play([numbers.policy(vector) for vector in search.ask()], starts)
        if np.median((before - returns).mean(axis=1)) < MOST_LOST * abs(before.mean()):
            break
    return search, float(size)


class Episodes:
    """Plays episodes, counts them, and gives their seeds."""

    def __init__(self, evaluate: Evaluate, seed: int, n_episodes: int = 1, *, shared_by_all: bool = False) -> None:
        self._evaluate, self._seed = evaluate, seed
        self._n_episodes, self._shared_by_all = n_episodes, shared_by_all
        self.n_played = 0

    def __call__(self, policies: Sequence[Any], seeds: IntArray) -> FloatArray:
        """Return the returns (k, m) of policies in the episodes of seeds (k, m), or (m,) where all play the same."""
        seeds = np.broadcast_to(seeds, (len(policies), seeds.shape[-1])).copy()
        returns = np.asarray(self._evaluate(policies, seeds), dtype=np.float64)
        if returns.shape != seeds.shape or not np.isfinite(returns).all():
            raise ValueError(
                f"evaluate returned {'numbers that are not finite' if returns.shape == seeds.shape else returns.shape}"
                f", expected {seeds.shape} finite returns: one for each of {len(seeds)} policies and "
                f"{seeds.shape[1]} episodes"
            )
        self.n_played += seeds.size
        return returns

    def fixed(self, seeds: tuple[int, int], n: int) -> IntArray:
        """Return n successive seeds from a range, (n,)."""
        start = np.random.default_rng([self._seed, seeds[0]]).integers(seeds[0], seeds[1] - n)
        return np.arange(start, start + n, dtype=np.int64)

    def of_iteration(self, iteration: int, n_vectors: int) -> IntArray:
        """Return the seeds (n_vectors, n_episodes) of an iteration's episodes."""
        generator = np.random.default_rng([self._seed, SEARCH_SEEDS[0], iteration])
        n_own = 1 if self._shared_by_all else n_vectors // 2
        own: IntArray = generator.integers(*SEARCH_SEEDS, (n_own, self._n_episodes))
        return np.repeat(own, n_vectors // n_own, axis=0)


class _Account:
    """The report as it grows."""

    def __init__(self, start: PolishReport, play: Episodes, report: Callable[[PolishReport], None] | None) -> None:
        self._so_far, self._play, self._report = start, play, report

    def add_candidate(self, iteration: int, mean: float) -> None:
        self._tell(candidates=(*self._so_far.candidates, (iteration, mean)))

    def finish(self, confirmation: tuple[float, float] | None, *, kept: bool) -> None:
        self._tell(confirmation=confirmation, kept=kept)

    def _tell(self, **changes: Any) -> None:
        self._so_far = replace(self._so_far, n_played=self._play.n_played, **changes)
        if self._report:
            self._report(self._so_far)
