"""Stage simplify: a shorter program of the pruned tree, as far as the return in the environment allows."""

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import otr
from otr.shorten.edits import n_numbers, without_idle_head
from otr.shorten.simplify import Judge, Simplification
from pipelines.config.stages import SimplificationConfig
from pipelines.engine.seeding import episode_seeds
from pipelines.engine.stage import Inputs, Stage, picked
from pipelines.engine.store import write_csv, write_json
from pipelines.play.boxes import box_around
from pipelines.play.episodes import Rollout, moments, play_evaluation, play_seeds
from pipelines.play.printed_programs import and_names, write_picture, write_program
from pipelines.play.spaces import spaces, state_limits
from pipelines.stages.evaluate import episode_rows
from pipelines.stages.polish import SearchedSettings, search
from pipelines.stages.prune import load_tree

MAX_ATTEMPTS = 4
FIRST_LOOK = 0.2  # of the deciding episodes: a tree that loses clearly on these plays no more
ANNOUNCE_S = 10.0
CLOSE = 0.05  # of an action's range: closer actions count as the same


@dataclass(frozen=True)
class SimplifySettings(SearchedSettings):
    """What the stage reads of a run's configuration; how it is polished again is not keyed: the stage polish is."""

    simplification: SimplificationConfig


def simplify(inputs: Inputs, settings: SimplifySettings, out: Path) -> None:
    """Write the simpler tree, its `program.txt`, its `episodes.csv` on the evaluation seeds, and `report.json`.

    A change is allowed if on the deciding episodes the mean return falls by no more than `return_loss` of its size, one
    standard error of the paired differences included, and the outcome is checked on as many others. With `action_bound`
    it is allowed if no action changes by more than that on the environment's box of states or, where that is open, on
    the box around those visited. The reported returns use a third set of episodes, the evaluation's.

    After polish=true the polished tree is made shorter, and the shorter one is polished again, unless a bound on
    actions decides: only what is not zero moves, so it stays as short. What that returns less than the tree it came
    from is measured on a fourth set of episodes, which decides nothing.
    """
    tree = load_tree(inputs.get("polish") or inputs["prune"])
    judge = _Judge(tree, settings, 0, keep_states=True)
    states = judge.played.states
    again: dict[str, Any] = {}
    if settings.simplification.action_bound is not None:
        box = state_limits(settings.env) or box_around(states, 0.0)
        allows: Judge = otr.within(tree, box, settings.simplification.action_bound)
        simpler, n_attempts = otr.simplify(tree, allows, states, refit=settings.simplification.refit), 1
    else:
        simpler, n_attempts, again = _simplest(tree, judge, states, settings, polishes="polish" in inputs)
    otr.save(simpler.tree, out / "tree")
    write_program(simpler.tree, settings.env, out)
    write_picture(simpler.tree, settings.env, states, out)
    _report(tree, simpler, judge, n_attempts, again, settings, out)


def _polished_again(simpler: Simplification, settings: SimplifySettings) -> tuple[Simplification, dict[str, Any]]:
    """Return the simpler tree polished on the return, and what the report says of that."""
    box = spaces(settings.env).box
    # The constants of a tree without a clip are within the actions, and must stay there.
    clipped = simpler.tree if box is None else simpler.tree.replace(head=simpler.tree.head.clipped_to(*box))
    polished = search(clipped, settings, "simplify")
    played = play_evaluation(simpler.tree.predict, settings)
    report = {"polished_again": polished.report | moments(played, "_before")}
    if not polished.report["kept"]:
        return simpler, report
    tree = without_idle_head(polished.policy)
    return dataclasses.replace(simpler, tree=tree, n_numbers=n_numbers(tree)), report


def _simplest(
    tree: otr.ObliqueTree, judge: "_Judge", states: np.ndarray, settings: SimplifySettings, *, polishes: bool
) -> tuple[Simplification, int, dict[str, Any]]:
    """Return the simpler tree, the number of attempts that it took, and what the report says of polishing it again.

    A search over hundreds of trees on the same episodes overestimates the tree that it keeps. So its outcome plays
    as many others; where it loses more than is allowed on them, the search is done again with half the allowance, and
    after MAX_ATTEMPTS the tree stays as it is. A tree that is polished again must lose nothing: no more than one
    standard error of the paired differences.
    """
    check, n_attempts = _Judge(tree, settings, 1), 0
    again: dict[str, Any] = {}
    while True:
        n_attempts += 1
        simpler = otr.simplify(tree, judge, states, refit=settings.simplification.refit)
        if polishes:
            simpler, again = _polished_again(simpler, settings)
        loss, error = check.loss(simpler.tree)
        if loss <= (error if polishes else check.allowed):
            break
        if n_attempts == MAX_ATTEMPTS:
            print(f"simplify: {n_attempts} shorter trees lost too much on other episodes; none is kept", flush=True)
            same = simpler.n_numbers_before
            simpler, again = dataclasses.replace(simpler, tree=tree, n_numbers=same, n_kept=0), {}
            break
        judge.allowed /= 2
        if polishes:
            print(
                f"simplify: the shorter tree loses {loss:.2f} ± {error:.2f}; again with half the allowance", flush=True
            )
    if polishes:
        loss, error = _Judge(tree, settings, 2).loss(simpler.tree)
        n_episodes = settings.simplification.n_episodes
        again["loss"] = {"mean": loss, "standard_error": error, "n_episodes": n_episodes}
    return simpler, n_attempts, again


class _Judge:
    """Whether a tree's returns on the deciding episodes are almost the original's; prints how far the search is."""

    def __init__(
        self, tree: otr.ObliqueTree, settings: SimplifySettings, index: int, *, keep_states: bool = False
    ) -> None:
        """Play the original in the deciding episodes, or with index 1 or 2 in others that decide nothing before."""
        self.settings = settings
        self.seeds = episode_seeds(settings.seed, "simplify", settings.simplification.n_episodes, index)
        self.played = self._play(tree, self.seeds, keep_states)
        self.allowed = settings.simplification.return_loss * abs(self.played.mean_return)
        self.n_played = self.n_tried = 0
        self.announced = time.monotonic()

    def __call__(self, tree: otr.ObliqueTree) -> bool:
        self.n_tried += 1
        first = max(1, round(FIRST_LOOK * len(self.seeds)))
        losses = self._losses(tree, 0, first)
        accepted = False
        if first == len(self.seeds) or losses.mean() - 2 * _standard_error(losses) <= self.allowed:
            losses = np.concatenate((losses, self._losses(tree, first, len(self.seeds))))
            accepted = bool(losses.mean() + _standard_error(losses) <= self.allowed)
        if time.monotonic() - self.announced >= ANNOUNCE_S:
            self.announced = time.monotonic()
            print(f"simplify: {self.n_tried} changes tried, {self.n_played:,} episodes played", flush=True)
        return accepted

    def loss(self, tree: otr.ObliqueTree) -> tuple[float, float]:
        """Return how much less the tree earns than the original, on average, and the standard error of that."""
        losses = self._losses(tree, 0, len(self.seeds))
        return float(losses.mean()), _standard_error(losses)

    def _losses(self, tree: otr.ObliqueTree, start: int, stop: int) -> np.ndarray:
        """Return how much less the tree earns than the original, episode by episode."""
        if start == stop:
            return np.zeros(0)
        self.n_played += stop - start
        return np.asarray(self.played.returns[start:stop] - self._play(tree, self.seeds[start:stop]).returns)

    def _play(self, tree: otr.ObliqueTree, seeds: Sequence[int], keep_states: bool = False) -> Rollout:
        workers = self.settings.n_workers
        return play_seeds(tree.predict, self.settings.env, seeds, keep_states=keep_states, n_workers=workers)


def _standard_error(values: np.ndarray) -> float:
    return float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else 0.0


def _report(
    tree: otr.ObliqueTree,
    simpler: Simplification,
    judge: _Judge,
    n_attempts: int,
    again: dict[str, Any],
    settings: SimplifySettings,
    out: Path,
) -> None:
    """Play the evaluation episodes with both trees and write the results."""
    before = play_evaluation(tree.predict, settings, keep_states=True)
    after = play_evaluation(simpler.tree.predict, settings)
    states = before.states
    ours, theirs = (np.asarray(each.predict(states), dtype=np.float64) for each in (simpler.tree, tree))
    box = spaces(settings.env).box
    close = 0.0 if box is None else CLOSE * (box[1] - box[0])
    same = (np.abs(ours - theirs) <= close).reshape(len(states), -1).all(axis=1)
    columns = ("episode", "seed", "return")
    write_csv(out / "episodes.csv", ({name: row[name] for name in columns} for row in episode_rows(after)), columns)
    print(f"simplify: {simpler.n_tried} changes tried, {simpler.n_kept} kept", flush=True)
    write_json(
        out / "report.json",
        {
            "n_leaves_before": tree.n_leaves,
            "n_leaves": simpler.tree.n_leaves,
            "depth": simpler.tree.depth,
            "n_numbers_before": simpler.n_numbers_before,
            "n_numbers": simpler.n_numbers,
            "n_tried": simpler.n_tried,
            "n_kept": simpler.n_kept,
            "n_attempts": n_attempts,
            "n_deciding_episodes": len(judge.seeds),
            "return_loss": settings.simplification.return_loss,
            "action_bound": settings.simplification.action_bound,
            "n_episodes": len(after.seeds),
            **moments(before, "_before"),
            **moments(after),
            "fidelity": float(same.mean()),
            "fidelity_tolerance": 0.0 if box is None else CLOSE,
            "mean_difference": float(np.abs(ours - theirs).mean()),
            **again,
        },
    )


SIMPLIFY_KEYS = picked(
    env="env", seed="seed", n_episodes="simplification.n_episodes", return_loss="simplification.return_loss",
    action_bound="simplification.action_bound", refit="simplification.refit", evaluate="evaluate"
)  # fmt: skip
# After polish=true it reads the stage polish alone (`pipelines.runs.stage_table.stages_of`), keyed by the
# settings of polishing.
SIMPLIFY = Stage(
    "simplify", version=1, inputs=("prune",), keyed=and_names(SIMPLIFY_KEYS), run=simplify, settings=SimplifySettings
)
