"""DAgger: an oracle is imitated on the states that its imitators visit (Ross, Gordon & Bagnell 2011).

    D = states of the oracle's own episodes
    for r = 0 .. n_rounds:  fit tree r to the oracle's answers on D;  add the states that tree r visits to D

The environment is the caller's: `play` plays episodes. All that a run has done is in its folder, committed once a
round, so that a killed run goes on from its last whole round and ends with the same result, bit for bit on one type of
processor with the same package versions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from otr.control.dagger.iterate_selection import successive_halving
from otr.control.dagger.run_folder import RunFolder
from otr.control.rollout import Policy, Rollout
from otr.control.settings import DaggerSettings
from otr.core.arrays import FloatArray
from otr.core.pattern_tree import PatternTree
from otr.core.smooth_network import Oracle
from otr.core.tree import ObliqueTree
from otr.errors import InvalidNetworkError
from otr.setting import check_settings

_LABELLING_ROWS = 2**14

# Plays one episode a seed with a policy that acts on batches of states; the bool says whether the states are asked for.
Play = Callable[[Policy, Sequence[int], bool], Rollout]
EpisodeSeeds = Callable[[str, int, int], Sequence[int]]  # (name, index, n) -> n reset seeds


class TreeFit(Protocol):
    """Fits a tree to states X (n, d), memory-mapped, and the oracle's answers on them.

    A network represents its tree of activation patterns. For an oracle of labels, answers (n, o) are its affine
    outputs, whose argmax is the label, and weights (n,) say how much a row matters; else answers (n, o) are its actions
    and weights are None. All randomness is the generator's.
    """

    def __call__(
        self, X: FloatArray, answers: FloatArray, weights: FloatArray | None, generator: np.random.Generator, /
    ) -> ObliqueTree | PatternTree: ...


@dataclass(frozen=True)
class DaggerProgress:
    """A round that is done: in round r the oracle (r = 0) or tree r - 1 played, and tree r was fitted.

    Attributes:
        round: r.
        n_rounds: as in `DaggerSettings`.
        n_rows: rows that tree r was fitted to.
        n_steps: environment steps so far.
        return_mean: of the episodes played in this round.
        n_leaves, depth: of tree r.
        seconds: the round took.
    """

    round: int
    n_rounds: int
    n_rows: int
    n_steps: int
    return_mean: float
    n_leaves: int
    depth: int
    seconds: float


@dataclass(frozen=True)
class Iterate:
    """One of DAgger's trees.

    Attributes:
        round: its number, from 0.
        n_rows: rows that it was fitted to.
        rollout_mean: mean return of the episodes that it played to gather states.
        selection_mean: mean return of all its selection episodes, among them those.
        n_selection_episodes: their number.
        n_leaves, depth: of the tree.
        seconds: its round took: the episodes before it, and its fit.
    """

    round: int
    n_rows: int
    rollout_mean: float
    selection_mean: float
    n_selection_episodes: int
    n_leaves: int
    depth: int
    seconds: float


@dataclass(frozen=True)
class DaggerResult:
    """The result of DAgger.

    Attributes:
        tree: the iterate chosen.
        round: its number.
        oracle_mean: mean return of the oracle's episodes.
        iterates: all of them.
        n_steps: environment steps, those of the selection included.
    """

    tree: ObliqueTree | PatternTree
    round: int
    oracle_mean: float
    iterates: tuple[Iterate, ...]
    n_steps: int


def run_dagger(
    oracle: Oracle,
    fit: TreeFit,
    play: Play,
    episode_seeds: EpisodeSeeds,
    settings: DaggerSettings,
    seed: np.random.SeedSequence,
    folder: Path,
    *,
    on_round: Callable[[DaggerProgress], None] | None = None,
) -> DaggerResult:
    """Imitate `oracle` under DAgger and return the iterate that is best on selection episodes.

    The weight of a state is the largest of the oracle's affine outputs less the smallest: V - min Q for action values
    and, as the outputs of a PPO actor are log-probabilities up to a constant, the largest log-probability less the
    smallest for those (Bastani et al. 2018, section 3). The choice is by successive halving: an iterate's first
    selection episodes are those that it plays in the next round, which it was not fitted to.

    Args:
        oracle: its head is `Argmax` for labels; continuous actions have `TanhBox`, `ClipBox` or `Identity`.
        fit: from states, answers and weights to a tree; see `TreeFit`.
        play: plays episodes; must depend on policy and seeds alone.
        episode_seeds: gives reset seeds. Asked for "oracle" with index 0, "dagger" with the playing tree's number as
            index, and "selection" with the stage of the halving as index; no two of these may share a seed, nor any of
            them one with episodes that are reported.
        settings: how much is played.
        seed: root of the fits' randomness; tree r draws from its child (..., r).
        folder: of the working files, created if missing: states.f64, answers.f64, weights.f64, dagger.json and
            iterate-<r>.npz and .json. A run that was stopped goes on in it, and one that is done is returned as it
            was: `fit` and `play` are functions and not compared, so take another folder for others.
        on_round: called after every round of this call.

    Raises:
        InvalidNetworkError: the oracle's head is `Sign`.
        ValueError: a setting is out of its range.
        ArtefactError: the folder holds a run of another oracle, seed or settings, or a file of it is gone or cut off.
    """
    check_settings(settings)
    if oracle.head.gives_labels and oracle.head.n_labels(oracle.n_outputs) != oracle.n_outputs:
        raise InvalidNetworkError("the oracle's head is Sign; give it two outputs and Argmax")
    state = RunFolder(folder, oracle, seed, asdict(settings))
    run = _Run(oracle, fit, play, episode_seeds, settings, seed, state)
    while run.n_trees <= settings.n_rounds:
        progress = run.round()
        if on_round is not None:
            on_round(progress)
    return run.choose()


@dataclass(frozen=True)
class _Run:
    """A run, resumed from the state in its folder."""

    _oracle: Oracle
    _fit: TreeFit
    _play: Play
    _episode_seeds: EpisodeSeeds
    _settings: DaggerSettings
    _seed: np.random.SeedSequence
    _folder: RunFolder

    @property
    def n_trees(self) -> int:
        return len(self._folder.state["trees"])

    def round(self) -> DaggerProgress:
        """Let the oracle or the newest tree play, fit the next tree, and commit."""
        start, r = time.perf_counter(), self.n_trees
        episodes = self._rollout(r)
        states = episodes.states
        n_rows = self._folder.append(states, *_label(self._oracle, np.asarray(states, dtype=np.float64)))
        child = np.random.SeedSequence(self._seed.entropy, spawn_key=(*self._seed.spawn_key, r))
        data = self._folder.data(n_rows, has_weights=self._oracle.head.gives_labels)
        tree = self._fit(*data, np.random.default_rng(child))
        self._folder.save_tree(r, tree)
        n_leaves, depth = _size(tree)
        progress = DaggerProgress(
            round=r,
            n_rounds=self._settings.n_rounds,
            n_rows=n_rows,
            n_steps=self._n_steps_after(episodes),
            return_mean=float(np.mean(episodes.returns)),
            n_leaves=n_leaves,
            depth=depth,
            seconds=time.perf_counter() - start,
        )
        row = {name: getattr(progress, name) for name in ("n_rows", "n_leaves", "depth", "seconds")}
        trees = [*self._folder.state["trees"], row]
        self._folder.commit(n_rows=n_rows, **self._played(episodes), trees=trees)
        return progress

    def choose(self) -> DaggerResult:
        """Return the best tree; each candidate's episodes of a stage are committed as they are played."""
        if len(self._folder.state["rollouts"]) == self.n_trees:  # the last tree has not played yet
            episodes = self._rollout(self.n_trees, keep_states=False)
            self._folder.commit(**self._played(episodes))
        state = self._folder.state
        oracle_returns, *first_returns = state["rollouts"]
        best, returns = successive_halving(first_returns, self._settings.n_choice_episodes, self._stage_returns)
        iterates = tuple(
            Iterate(
                round=r,
                rollout_mean=float(np.mean(first_returns[r])),
                selection_mean=float(np.mean(returns[r])),
                n_selection_episodes=len(returns[r]),
                **row,
            )
            for r, row in enumerate(state["trees"])
        )
        oracle_mean, n_steps = float(np.mean(oracle_returns)), self._folder.state["n_steps"]
        return DaggerResult(self._folder.tree(best), best, oracle_mean, iterates, n_steps)

    def _rollout(self, r: int, keep_states: bool = True) -> Rollout:
        """Play round r's episodes: the oracle's for r = 0, else tree r - 1's."""
        if r == 0:
            seeds = self._episode_seeds("oracle", 0, self._settings.n_initial_episodes)
            return self._play(self._oracle.predict, seeds, keep_states)
        seeds = self._episode_seeds("dagger", r - 1, self._settings.n_episodes)
        return self._play(self._folder.tree(r - 1).predict, seeds, keep_states)

    def _stage_returns(self, stage: int, candidate: int, n_episodes: int) -> list[float]:
        key = f"{stage}/{candidate}"
        if key not in self._folder.state["selection"]:
            seeds = self._episode_seeds("selection", stage, n_episodes)
            episodes = self._play(self._folder.tree(candidate).predict, seeds, False)
            selection = {**self._folder.state["selection"], key: episodes.returns.tolist()}
            self._folder.commit(n_steps=self._n_steps_after(episodes), selection=selection)
        returns: list[float] = self._folder.state["selection"][key]
        return returns

    def _played(self, episodes: Rollout) -> dict[str, Any]:
        """Return what changes in the state by a round's episodes."""
        rollouts = [*self._folder.state["rollouts"], episodes.returns.tolist()]
        return {"n_steps": self._n_steps_after(episodes), "rollouts": rollouts}

    def _n_steps_after(self, episodes: Rollout) -> int:
        n_steps: int = self._folder.state["n_steps"]
        return n_steps + int(np.sum(episodes.lengths))


def _label(oracle: Oracle, X: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Return answers (n, o) and, for labels, weights (n,): the largest output less the smallest."""
    parts = [oracle.forward(X[start : start + _LABELLING_ROWS]) for start in range(0, len(X), _LABELLING_ROWS)]
    outputs = np.concatenate(parts)
    if oracle.head.gives_labels:
        return outputs, outputs.max(axis=1) - outputs.min(axis=1)
    return oracle.head(outputs), None


def _size(tree: ObliqueTree | PatternTree) -> tuple[int, int]:
    """Return the number of leaves and the depth."""
    return (tree.n_paths, tree.n_bits) if isinstance(tree, PatternTree) else (tree.n_leaves, tree.depth)
