"""Which iterate of DAgger is kept: successive halving on episodes for this purpose only."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

# (stage, candidate, number of episodes) -> returns
PlayStage = Callable[[int, int, int], Sequence[float]]


def halving_plan(n_candidates: int, n_episodes: int) -> list[tuple[int, int]]:
    """Return, stage by stage, how many candidates play and how many further episodes each of them plays.

    The better half continues: of n candidates (n + 1) // 2, until one would be left. The episodes double from stage to
    stage as far as whole numbers allow, so that each stage costs about the same, and sum to `n_episodes`. Two
    candidates play them all.
    """
    n_left = [2] if n_candidates == 2 else []
    while n_candidates > 1:
        n_candidates = (n_candidates + 1) // 2
        if n_candidates > 1:
            n_left.append(n_candidates)
    whole = 2 ** len(n_left) - 1
    ends = [0] + [n_episodes * (2 ** (stage + 1) - 1) // whole for stage in range(len(n_left))]
    return [(n, stop - start) for n, start, stop in zip(n_left, ends[:-1], ends[1:], strict=True)]


def successive_halving(
    first_returns: Sequence[Sequence[float]], n_selection_episodes: int, play: PlayStage
) -> tuple[int, list[list[float]]]:
    """Return the best candidate, and every candidate's returns on selection episodes (Jamieson & Talwalkar 2016).

    Candidates are ranked by the mean of all returns they have so far, ties to the earlier one. `first_returns` are
    known already, as many for each; the last two candidates play until each has `n_selection_episodes`, counting these.
    All candidates of a stage play the same episodes.
    """
    returns = [list(map(float, first)) for first in first_returns]
    candidates = _ranking(returns, range(len(returns)))
    plan = halving_plan(len(returns), max(0, n_selection_episodes - len(returns[0])))
    for stage, (n_left, n_episodes) in enumerate(plan):
        candidates = candidates[:n_left]
        for candidate in sorted(candidates) if n_episodes else []:
            returns[candidate].extend(play(stage, candidate, n_episodes))
        candidates = _ranking(returns, candidates)
    return candidates[0], returns


def _ranking(returns: Sequence[Sequence[float]], candidates: Sequence[int]) -> list[int]:
    means = {candidate: float(np.mean(returns[candidate])) for candidate in candidates}
    return sorted(candidates, key=lambda candidate: (-means[candidate], candidate))
