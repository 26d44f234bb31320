"""Which inputs a tree's answers depend on, over states."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import FloatArray, as_batch
from otr.core.pattern_tree import PatternTree
from otr.core.pruning import prune_unreached
from otr.core.tree import ObliqueTree, require_tree
from otr.explanation.explain import outputs_named
from otr.extras import naming_the_extra
from otr.programs.names import shown_names

if TYPE_CHECKING:
    import pandas as pd

DECISIONS = "decisions"  # the last column of `to_frame`


@dataclass(frozen=True)
class Importance:
    """What `importance` returns; ``print`` shows it as a table, the largest first.

    Attributes:
        outputs: (o, d), in units of the outputs, before the head.
        decisions: (d,) shares of the tests' decisions, with a sum of 1; zeros where no state passes a test.
        deviations: (d,) of the states, in the inputs' units.
        feature_names, output_names: of inputs and outputs.
    """

    outputs: FloatArray
    decisions: FloatArray
    deviations: FloatArray
    feature_names: tuple[str, ...]
    output_names: tuple[str, ...]

    def to_frame(self) -> pd.DataFrame:
        """Return a row for each input and a column for each output, then one of the decisions."""
        with naming_the_extra("Importance.to_frame"):
            import pandas as pd
        columns = [*self.output_names, DECISIONS]
        return pd.DataFrame(np.column_stack((self.outputs.T, self.decisions)), list(self.feature_names), columns)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON-ready data."""
        return dict(json.loads(json.dumps(asdict(self), default=lambda v: v.tolist())))

    def __str__(self) -> str:
        heads, table = ["", *self.output_names, DECISIONS], np.vstack((self.outputs, self.decisions)).T
        order = np.argsort(-(table / np.maximum(table.max(axis=0), 1e-300)).max(axis=1), kind="stable")
        rows = [heads, *([self.feature_names[i], *map("{:.3g}".format, table[i])] for i in order)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return "\n".join("  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows)


def importance(
    tree: ObliqueTree | PatternTree,
    states: ArrayLike,
    *,
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
) -> Importance:
    """Return how much each input matters to a tree's outputs, and to the decisions of its tests, over states.

    With M_k the map of leaf k, s_i the standard deviation of input i over all states, and means over states x:

        outputs[o, i] = mean_x |M_leaf(x)[o, i]| s_i           in units of output o
        decisions[i]  = mean over all tests (P, v) that states pass of |P_i| s_i / sum_j |P_j| s_j

    The first is a standardised regression coefficient (Bring 1994, The American Statistician 48:3), averaged over
    leaves by visits. The second counts each test once for every state that passes it, and divides it among its inputs;
    for a tree with labels it is what says which inputs decide. Neither sees that inputs vary together.

    Args:
        tree: any tree; of a `PatternTree` with all its paths those that the states take.
        states: (n, d), at least one; where the policy goes, such as ``rollout(...).states``.
        feature_names, output_names: as in `to_text`.

    Raises:
        TypeError: `tree` is none.
        ValueError: there are no states, one holds a NaN, or names do not fit.

    Examples:
        >>> tree = otr.parse_program("if speed <= 0: 2 angle + 0.1 speed else: -angle", ["angle", "speed"])
        >>> print(otr.importance(tree, [[1, -4], [-1, -4], [1, 4], [-1, 4]], feature_names=["angle", "speed"]))
                y0  decisions
        angle  1.5          0
        speed  0.2          1
    """
    if isinstance(tree, PatternTree):
        tree = tree.to_tree() if tree.is_restricted else prune_unreached(tree, states)
    require_tree(tree)
    names, answers = shown_names(tree, feature_names, output_names)
    X = as_batch(states, tree.n_inputs)
    if not len(X) or not np.isfinite(X).all():
        raise ValueError("states hold none, or a number that is not finite; importance needs at least one state")
    deviations = X.std(axis=0)
    visits = np.bincount(tree.apply(X), minlength=tree.n_leaves) / len(X)
    taken = np.flatnonzero(visits)
    outputs = np.einsum("k,koi->oi", visits[taken], np.abs(tree.M[taken])) * deviations
    sizes = np.abs(tree.P) * deviations
    totals = sizes.sum(axis=1)
    passed = np.asarray(tree.decision_path(X).sum(axis=0), dtype=np.float64).ravel() * (totals > 0)
    shares = passed / np.where(totals > 0, totals, 1.0) @ sizes
    named = outputs_named(tree.head, tree.n_outputs, answers)
    return Importance(outputs, shares / max(passed.sum(), 1.0), deviations, tuple(names), named)
