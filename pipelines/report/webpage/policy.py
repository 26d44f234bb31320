"""A run's policy as a page shows it: the tree, its names and ranges, an episode, and its programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import otr
from otr.control.label_leaves import decided_leaves
from otr.programs.merging import merge_equal_leaves
from otr.programs.picture.colours import LABELS, level_colour
from otr.programs.walk import in_printed_order
from otr.shorten.edits import n_numbers
from pipelines.config.run import RunConfig
from pipelines.engine.command_text import command_text
from pipelines.engine.seeding import episode_seeds, evaluation_seeds
from pipelines.engine.store import read_summary
from pipelines.errors import PipelineError
from pipelines.play.episodes import play_seeds
from pipelines.play.spaces import action_names, feature_names, spaces, state_limits
from pipelines.report.webpage.episode import MOST_STEPS, packed, record
from pipelines.report.webpage.physical_units import unit_of
from pipelines.report.webpage.verdict import returns_of, verdict
from pipelines.runs.finished_run import results_of, tree_of
from pipelines.runs.questions import number_of

EXPORTS: dict[str, Callable[..., str]] = {
    "C": otr.to_c,
    "Python": otr.to_python,
    "Structured text": otr.to_structured_text,
}
WIDEST_LIMITS = 1e3  # limits of a state beyond these say nothing: the range is that of visited states
MARGIN = 0.1  # of the range of visited states, beyond it on either side
MOST_LEAVES, LONGEST_PROGRAM = 64, 100_000  # of a program, and its letters; a longer one is not readable
VISIBLE = 1e-4  # of the largest answer: a page writes three digits


@dataclass(frozen=True)
class Detail:
    """How much of a policy a page holds.

    Attributes:
        n_frames, frame_width, n_steps: of the episode; see `record`.
        export_bytes: a longer program in C and the like is left out, and the page names the command that writes it.
        tree_bytes: most that a tree's numbers may take as float32, in which they are then held where that changes no
            leaf and no visible answer on visited states; None for any tree, in float64.
        links_run: whether the page links to the run's folder.
    """

    n_frames: int
    frame_width: int
    export_bytes: int
    tree_bytes: int | None
    n_steps: int = MOST_STEPS
    links_run: bool = True


def policy_data(
    run: RunConfig, folder: Path, form: str, detail: Detail, certificate: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return what a page shows of one of a run's trees, as JSON-able data.

    Sibling leaves with one answer are merged and leaves are numbered as programs print them: see `page_tree`.

    Args:
        run, folder: the run.
        form: of its trees, as `tree_of` names them.
        detail: how much of it.
        certificate: the report of stage certify, where that was not a stage of the run.

    Raises:
        PipelineError: the tree is not there, is held as activation patterns, or is larger.
    """
    tree = page_tree(run, folder, form)
    n_numbers = sum(array.size for array in _numbers(tree).values())
    if detail.tree_bytes is not None and 4 * n_numbers > detail.tree_bytes:
        raise PipelineError(
            f"its {tree.n_leaves:,} leaves would take {4e-6 * n_numbers:.1f} MB of a page, on which a policy has "
            f"{1e-6 * detail.tree_bytes:g}; {command_for('otr-report', folder, form)} writes its page"
        )
    env, space = run.env, spaces(run.env)
    names, answers = feature_names(env, tree.n_inputs), action_names(env, tree.n_answers)
    (seed,) = evaluation_seeds(run.evaluate.first_seed, 1)
    of_pruning = episode_seeds(run.seed, "prune", min(2, run.prune.n_episodes))
    played = play_seeds(tree.predict, env, [*of_pruning, seed], keep_states=True, n_workers=1)
    visited, length = played.states, int(played.lengths[-1])
    programs = {
        language: written
        for language, write in EXPORTS.items()
        if 2 * n_numbers <= detail.export_bytes  # which no program's text undercuts
        and len(written := write(tree, feature_names=names, output_names=answers)) <= detail.export_bytes
    }
    return {
        "env": env.name,
        "form": form,
        "features": _features(run, names, visited),
        "answers": answers,
        **_importance(tree, visited, answers),
        "limits": None if space.box is None else [limits.tolist() for limits in space.box],
        "tree": tree_data(
            tree, visited, "<f4" if detail.tree_bytes is not None and _rounds_unseen(tree, visited) else "<f8"
        ),
        "episode": record(
            tree,
            env,
            seed,
            length=length,
            n_frames=detail.n_frames,
            width=detail.frame_width,
            most_steps=detail.n_steps,
        ),
        "texts": _texts(run, folder, form, tree),
        "exports": programs,
        "left_out": [language for language in EXPORTS if language not in programs],
        "export_command": command_for("otr-export", folder, form, "format=NAME"),
        "page_command": command_for("otr-report", folder, form),
        "verdict": verdict(run, folder, form, tree, visited, certificate),
    }


def command_for(program: str, folder: Path, form: str, *words: str) -> str:
    """Return the command that gives a run's tree to one of the programs, with further words."""
    results_dir, words = results_of(folder), (f"tree={form}", *words)
    if results_dir is None:
        return command_text(program, [f"run={folder}", *words])
    return command_text(program, [f"run={Path(*folder.parts[-5:]).as_posix()}", *words], results_dir)


def _numbers(tree: otr.ObliqueTree) -> dict[str, NDArray[np.float64]]:
    """Return the arrays of numbers that a page needs; leaves with labels need none."""
    return {"P": tree.P, "v": tree.v} | ({} if tree.labels is not None else {"M": tree.M, "c": tree.c})


def _rounds_unseen(tree: otr.ObliqueTree, states: NDArray[Any]) -> bool:
    """Return whether the tree in float32 takes the same leaves on states (n, d), and answers alike as far as shown."""
    with np.errstate(over="ignore"):
        rounded = {name: array.astype(np.float32).astype(np.float64) for name, array in _numbers(tree).items()}
    if not all(np.isfinite(array).all() for array in rounded.values()):
        return False
    near, answers = tree.replace(**rounded), tree.predict(states)
    is_near = np.allclose(near.predict(states), answers, rtol=0.0, atol=VISIBLE * float(np.abs(answers).max()))
    return is_near and np.array_equal(near.apply(states), tree.apply(states))


def _texts(run: RunConfig, folder: Path, form: str, tree: otr.ObliqueTree) -> list[list[str]]:
    """Return titles and programs, the shortest first: the simplified tree's where the run has one, and the whole."""
    features, answers = feature_names(run.env, tree.n_inputs), action_names(run.env, tree.n_answers)
    summary, trees = read_summary(folder), {form: tree}
    if "simplify" in summary:
        other = "simplified" if form != "simplified" else "polished" if "polish" in summary else "pruned"
        trees[other] = page_tree(run, folder, other)
    programs = []
    for each, shown in sorted(trees.items(), key=lambda item: n_numbers(item[1])):
        size = f"{number_of(shown.n_leaves, 'leaf')}, {number_of(n_numbers(shown), 'number')}"
        returns = returns_of(summary, each)
        title = f"{each} tree: {size}{f', returns {returns}' if returns else ''}"
        if shown.n_leaves > MOST_LEAVES:
            continue
        text = otr.to_text(shown, feature_names=features, output_names=answers)
        if len(text) <= LONGEST_PROGRAM:
            programs.append([title, text])
    return programs


def page_tree(run: RunConfig, folder: Path, form: str) -> otr.ObliqueTree:
    """Return one of a run's trees, labels decided by tests, equal siblings merged, its leaves in printed order."""
    tree = tree_of(form, run, folder)
    if not isinstance(tree, otr.ObliqueTree):
        raise PipelineError(
            f"{folder}: the {form} tree has too many leaves to be held as leaves, so there is nothing to draw; "
            "method=augtree imitates its policy by a small one"
        )
    decided = tree if tree.labels is not None else decided_leaves(tree, tree.head)
    return in_printed_order(merge_equal_leaves(decided))


def tree_data(tree: otr.ObliqueTree, visited: NDArray[Any], dtype: str = "<f8") -> dict[str, Any]:
    """Return a tree as JSON-able data, its numbers as `dtype` bit by bit, with the share of states (n, d) a leaf."""
    leaves = tree.apply(visited)
    shares = np.bincount(leaves, minlength=tree.n_leaves) / max(len(leaves), 1)
    head: dict[str, Any] = {"name": tree.head.name, "words": tree.head.in_words(tree.n_outputs)}
    if (limits := tree.head.limits(tree.n_outputs)) is not None:
        head |= {"low": limits[0].tolist(), "high": limits[1].tolist()}
    return {
        "left": packed(tree.children_left.astype("<i4")),
        "right": packed(tree.children_right.astype("<i4")),
        **{name: packed(array.astype(dtype)) for name, array in _numbers(tree).items()},
        "labels": None if tree.labels is None else packed(tree.labels.astype("<i4")),
        "head": head,
        "shares": packed(shares.astype("<f4")),
        "colours": _colours(tree, visited, leaves),
    }


def _importance(tree: otr.ObliqueTree, visited: NDArray[Any], answers: list[str]) -> dict[str, Any]:
    """Return the names of a tree's outputs, and what matters to them and to its tests in visited states (n, d)."""
    found = otr.importance(tree, visited, output_names=answers)
    *outputs, decisions = ([float(f"{v:.4g}") for v in row] for row in (*found.outputs, found.decisions))
    shown = {"outputs": outputs if tree.labels is None and tree.head.acts_by_output else None, "decisions": decisions}
    return {"outputs": found.output_names, "importance": shown}


def _colours(tree: otr.ObliqueTree, visited: NDArray[Any], leaves: NDArray[Any]) -> list[str]:
    """Return a colour a leaf: its label's, or that of its mean first action over the states that take it."""
    if tree.labels is not None:
        return [LABELS[int(label) % len(LABELS)][0] for label in tree.labels]
    first = np.asarray(tree.predict(visited), dtype=np.float64).reshape(len(visited), -1)[:, 0]
    total = np.bincount(leaves, weights=first, minlength=tree.n_leaves)
    n = np.bincount(leaves, minlength=tree.n_leaves)
    limits = tree.head.limits(tree.n_outputs)
    low, high = (first.min(), first.max()) if limits is None else (float(limits[0][0]), float(limits[1][0]))
    middle, half = (low + high) / 2, max((high - low) / 2, 1e-12)
    return [
        level_colour((t / k - middle) / half) if k else "#e4e7ea"
        for t, k in zip(total.tolist(), n.tolist(), strict=True)
    ]


def _features(run: RunConfig, names: list[str], visited: NDArray[Any]) -> list[dict[str, Any]]:
    """Return each input's name, unit, and range: that of the environment where it says one, else of visited states."""
    limits = state_limits(run.env)
    features = []
    for i, name in enumerate(names):
        low, high = float(visited[:, i].min()), float(visited[:, i].max())
        known = limits is not None and bool(
            limits[0][i] < limits[1][i] and max(abs(limits[0][i]), abs(limits[1][i])) <= WIDEST_LIMITS
        )
        if limits is not None and known:
            low, high = float(limits[0][i]), float(limits[1][i])
        else:
            margin = MARGIN * (high - low) or 1.0
            low, high = low - margin, high + margin
        features.append({"name": name, "unit": unit_of(run.env, name), "low": low, "high": high, "of_env": known})
    return features
