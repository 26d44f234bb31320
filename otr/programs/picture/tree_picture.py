"""A tree laid out as a picture, its root on the left: boxes and branches or, for many leaves, an icicle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from otr.core.tree import ObliqueTree
from otr.programs.merging import merge_equal_leaves
from otr.programs.names import check_tree, one_line, shown_names
from otr.programs.picture.boxes import NodeBox, tree_boxes, visits_of
from otr.programs.picture.branches import branches
from otr.programs.picture.formulas import Style
from otr.programs.picture.head_notes import head_note
from otr.programs.picture.icicle import icicle
from otr.programs.picture.scene import Scene

MOST_BRANCHES = 30  # leaves that are drawn as boxes; of more, an icicle is drawn
MOST_SHOWN = 400  # leaves of an icicle; what is more is folded up


def tree_scene(
    tree: ObliqueTree,
    *,
    feature_names: Sequence[str] | None,
    output_names: Sequence[str] | None,
    precision: int,
    max_terms: int,
    states: ArrayLike | None,
    max_depth: int | None,
    title: str | None,
) -> Scene:
    """Return the picture of a tree; arguments and errors are those of `draw_tree`."""
    check_tree(tree)
    tree = merge_equal_leaves(tree)
    features, answers = shown_names(tree, feature_names, output_names)
    style = Style(features, answers, precision, max_terms)
    visits = None if states is None else visits_of(tree, states)
    boxes = tree_boxes(tree, style, visits, _depth_shown(tree, max_depth))
    notes = _notes(tree, boxes, answers)
    draw = branches if sum(not box.children for box in boxes) <= MOST_BRANCHES else icicle
    return draw(boxes, one_line(title or ""), notes)


def _depth_shown(tree: ObliqueTree, max_depth: int | None) -> int | None:
    """Return the depth below which tests are folded up so that no more than MOST_SHOWN leaves are drawn."""
    n_shown = 1 + np.cumsum([len(level) for level in tree.levels])  # at depth 1, 2, ...
    most = int(np.count_nonzero(n_shown <= MOST_SHOWN))
    if most == tree.depth:
        return max_depth
    return most if max_depth is None else min(max_depth, most)


def _notes(tree: ObliqueTree, boxes: Sequence[NodeBox], answers: Sequence[str]) -> list[str]:
    """Return the lines below the picture."""
    notes = [head_note(tree)]
    if any(box.levels for box in boxes):
        several = f"s ({', '.join(answers[:6])}{', …' * (len(answers) > 6)})" if len(answers) > 1 else ""
        notes.append(f"colours: the answer{several} from low (blue) to high (orange)")
    if boxes[0].n_rows is not None:
        notes.append(f"per cent: of {boxes[0].n_rows:,} states")
    return [note for note in notes if note]
