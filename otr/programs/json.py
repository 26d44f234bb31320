"""A tree as JSON that any language can execute in a few lines: schema "otr/program/1"."""

from __future__ import annotations

import json
from collections.abc import Sequence

from otr.core.tree import ObliqueTree
from otr.programs.names import check_tree, give_labels, names_of

PROGRAM_SCHEMA = "otr/program/1"


def to_json(
    tree: ObliqueTree, *, feature_names: Sequence[str] | None = None, output_names: Sequence[str] | None = None
) -> str:
    """Return the tree as JSON, one node or leaf a line; every number in its shortest exact form.

        {"schema": "otr/program/1",
         "features": [d names],                           the components of a state x, in order
         "answer": "values" or "label",
         "outputs": [names]                               of the answer's values, or of the labels 0, 1, ...
         "head": {"name": "tanh_box", "low": ..., "high": ...},
         "root": 0,                                       or -1 in a tree of one leaf
         "nodes": [{"weights": [d], "offset": v, "left": r, "right": r}, ...],
         "leaves": [{"weights": [[d], ...], "offsets": [o], "label": k}, ...]}

    Start with r = root. While r >= 0, node r sends x left where weights . x + offset <= 0, else right. Then the leaf is
    leaves[-1 - r]. If it has a label, that is the answer. Else its outputs are y = weights x + offsets, and the answer
    follows by head.name: identity y; exp exp(y); clip_box min(max(y, low), high); tanh_box
    low + (tanh(y) + 1) / 2 * (high - low); sign 1 where y[0] > 0, else 0; argmax the first index of the largest y. low
    and high are a number for all outputs or one for each. With the head pid_box, of a actions, y is 1 + a vectors of
    one length: the terms, then each action's gains; an action is tanh_box of the sum of its gains times the terms.
    JSON's numbers are to be read as float64.

    Args:
        tree: any tree.
        feature_names, output_names: as in `to_text`.

    Raises:
        TypeError: `tree` is no ObliqueTree.
        ValueError: the wrong number of names, or names that are not distinct.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> import json
        >>> sorted(json.loads(otr.to_json(tree)))
        ['answer', 'features', 'head', 'leaves', 'nodes', 'outputs', 'root', 'schema']
    """
    check_tree(tree)
    features, answers = names_of(tree, feature_names, output_names)
    about = {
        "schema": PROGRAM_SCHEMA,
        "features": features,
        "answer": "label" if give_labels(tree) else "values",
        "outputs": answers,
        "head": tree.head.to_dict(),
        "root": 0 if tree.n_nodes else -1,
    }
    lines = [f'  "{key}": {_json(value)},' for key, value in about.items()]
    arrays = (tree.P, tree.v, tree.children_left, tree.children_right)
    nodes = [
        {"weights": P, "offset": v, "left": left, "right": right}
        for P, v, left, right in zip(*(array.tolist() for array in arrays), strict=True)
    ]
    leaves = [{"weights": M, "offsets": c} for M, c in zip(tree.M.tolist(), tree.c.tolist(), strict=True)]
    if tree.labels is not None:
        leaves = [leaf | {"label": label} for leaf, label in zip(leaves, tree.labels.tolist(), strict=True)]
    lines += [f'  "nodes": {_rows(nodes)},', f'  "leaves": {_rows(leaves)}']
    return "\n".join(["{", *lines, "}"]) + "\n"


def _json(value: object) -> str:
    return json.dumps(value, allow_nan=False)


def _rows(rows: Sequence[object]) -> str:
    return "[\n" + ",\n".join(f"    {_json(row)}" for row in rows) + "\n  ]" if rows else "[]"
