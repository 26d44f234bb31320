"""Why a tree answers as it does at a state: the tests passed, the leaf's map, and what would change the answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import FloatArray, as_states
from otr.core.clock import time_limit
from otr.core.domain import Box, Domain, as_domain
from otr.core.head import Head
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree
from otr.explanation.nearest import nearest_state
from otr.explanation.paths import Paths, Place, path_of, paths_of
from otr.programs.names import label_name, shown_names
from otr.programs.walk import affine_expression

_MOST_TERMS = 8  # of a line; the others are counted


@dataclass(frozen=True)
class PassedTest:
    """A test on a state's path.

    Attributes:
        node: of the tree; None for a test of the head, or of a network's hidden neuron.
        text: ``... <= 0``, in the inputs' names.
        margin: ``P @ x + v``, in the test's units; the test holds where it is at most 0.
    """

    node: int | None
    text: str
    margin: float

    @property
    def holds(self) -> bool:
        """Whether the state goes left."""
        return self.margin <= 0


@dataclass(frozen=True)
class Nearest:
    """The nearest state of another leaf or label: it is clear of all tests on its path by 1e-9, no such is nearer.

    Attributes:
        state: (d,).
        distance: Euclidean, in scales: ``|(state - x) / scales|``.
        leaf, answer: of this state.
        text: its answer in words.
    """

    state: FloatArray
    distance: float
    leaf: int
    answer: Any
    text: str


@dataclass(frozen=True)
class Explanation:
    """What `explain` returns; ``print`` shows it.

    Attributes:
        state: x, (d,).
        leaf: its number; of a `PatternTree` with all paths, whose bits are the path.
        answer, text: the answer as `predict` has it, and in words.
        tests: the tests passed, the root first.
        weights, constants: of the leaf's map y = weights @ x + constants, (o, d) and (o,).
        shares: weights * x, what each input adds to each output: (o, d).
        outputs: y, before the head: (o,).
        head: how the head changes the outputs, in words.
        nearest_leaf: the nearest state of another leaf, None if there is none.
        nearest_label: the nearest state with another label, None if there is none or answers are no labels.
        feature_names, output_names: of inputs and outputs.
    """

    state: FloatArray
    leaf: int
    answer: Any
    text: str
    tests: tuple[PassedTest, ...]
    weights: FloatArray
    constants: FloatArray
    shares: FloatArray
    outputs: FloatArray
    head: str
    nearest_leaf: Nearest | None
    nearest_label: Nearest | None
    feature_names: tuple[str, ...]
    output_names: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON-ready data."""
        made: dict[str, Any] = _plain(self)
        return made

    def __str__(self) -> str:
        lines = [f"leaf {self.leaf}: {self.text}", *(["tests passed:"] if self.tests else [])]
        for test in self.tests:
            of = "  " if test.node is not None else "  unit or head: "
            lines.append(f"{of}{test.text}: {'yes' if test.holds else 'no'}, {test.margin:.4g}")
        for o, name in enumerate(self.output_names):
            if np.ndim(self.answer) == 0 and not self.weights[o].any():
                continue
            lines.append(f"{name} = {self.outputs[o]:.4g}, the sum of")
            order = np.argsort(-np.abs(self.shares[o]), kind="stable")
            order = order[self.shares[o, order] != 0]
            for i in order[:_MOST_TERMS]:
                product = f"{self.weights[o, i]:.4g} times {self.state[i]:.4g}"
                lines.append(f"  {self.shares[o, i]:+.4g}  {self.feature_names[i]} ({product})")
            if len(rest := order[_MOST_TERMS:]):
                lines.append(f"  {self.shares[o, rest].sum():+.4g}  {len(rest)} more inputs")
            lines.append(f"  {self.constants[o]:+.4g}  constant")
        lines.append(f"head: {self.head}")
        for what, found in (("leaf", self.nearest_leaf), ("label", self.nearest_label)):
            if found is not None:
                lines.append(f"nearest state of another {what}, {found.distance:.4g} away: {self._moves(found)}")
                lines.append(f"  leaf {found.leaf}: {found.text}")
        return "\n".join(lines)

    def _moves(self, found: Nearest) -> str:
        moved = np.abs(found.state - self.state)
        order = np.argsort(-moved, kind="stable")[: max(int((moved > 0).sum()), 1)]
        most = [f"{self.feature_names[i]} {self.state[i]:.4g} -> {found.state[i]:.4g}" for i in order[:_MOST_TERMS]]
        return ", ".join([*most, *([f"{len(order) - _MOST_TERMS} more"] if len(order) > _MOST_TERMS else [])])


def explain(
    tree: ObliqueTree | PatternTree,
    x: ArrayLike,
    *,
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    scales: ArrayLike | None = None,
    domain: Box | Domain | None = None,
    max_seconds: float | None = None,
) -> Explanation:
    """Return why a tree answers as it does at a state: tests and margins, shares of the inputs, nearest other answers.

    Args:
        tree: any tree, also what `parse_program` reads; of a network too wide for a tree, its `PatternTree`.
        x: one state (d,).
        feature_names, output_names: as in `to_text`.
        scales: (d,), above 0: what counts as a move by 1 in each input, such as ``states.std(axis=0)``; None is 1.
        domain: where a nearest state may lie; None is all of R^d.
        max_seconds: refuse to look for longer. A wide `PatternTree` may need it.

    Raises:
        TypeError: `tree` is none.
        ValueError: x is no single finite state, or not in the domain, a scale is not above 0, or names do not fit.
        TimeLimitError: `max_seconds` were over.

    Examples:
        >>> import otr
        >>> tree = otr.parse_program("if angle + 0.5 rate <= 0: left else: right", ["angle", "rate"], labels=True)
        >>> print(otr.explain(tree, [0.2, -0.1], feature_names=["angle", "rate"]))
        leaf 1: 1
    """
    paths = paths_of(tree)
    policy = tree.network if isinstance(tree, PatternTree) else tree
    names, answers = shown_names(policy, feature_names, output_names)
    state, widths, box = _checked(x, scales, domain, tree.n_inputs)
    *passed, end = path_of(paths, state)
    forms, answer, own = paths.outputs(end), tree.predict(state), paths.leaf_of(state)

    def nearest(wanted: Callable[[FloatArray], bool]) -> Nearest | None:
        found = nearest_state(paths, state, wanted, widths, box)
        if found is None:
            return None
        distance, answered = float(np.linalg.norm((found - state) / widths)), tree.predict(found)
        leaf = paths.leaf(path_of(paths, found)[-1])
        return Nearest(found, distance, leaf, answered, _in_words(answered, answers))

    with time_limit(max_seconds, lambda: "the nearest states of another leaf and label were not found"):
        nearest_leaf = nearest(lambda s: bool(paths.leaf_of(s) != own))
        nearest_label = nearest(lambda s: bool(tree.predict(s) != answer)) if np.ndim(answer) == 0 else None
    return Explanation(
        state=state,
        leaf=paths.leaf(end),
        answer=answer,
        text=_in_words(answer, answers),
        tests=tuple(_passed(paths, place, state, widths, names) for place in passed),
        weights=forms[:, :-1],
        constants=forms[:, -1],
        shares=forms[:, :-1] * state,
        outputs=forms @ np.append(state, 1.0),
        head="the tests decide the label" if paths.decides else policy.head.in_words(policy.n_outputs),
        nearest_leaf=nearest_leaf,
        nearest_label=nearest_label,
        feature_names=tuple(names),
        output_names=tuple(outputs_named(policy.head, policy.n_outputs, answers)),
    )


def outputs_named(head: Head, n_outputs: int, answers: Sequence[str]) -> list[str]:
    """Return names of the outputs: the answers', but for terms and gains, and the output of `Sign`."""
    joined = head.output_names(n_outputs, answers)
    return joined or (list(answers) if len(answers) == n_outputs else [f"y{i}" for i in range(n_outputs)])


def _checked(
    x: ArrayLike, scales: ArrayLike | None, domain: Box | Domain | None, n_inputs: int
) -> tuple[FloatArray, FloatArray, Domain]:
    state, box = as_states(x, n_inputs), as_domain(domain, n_inputs)
    if state.ndim != 1 or not np.isfinite(state).all():
        raise ValueError(f"x has shape {state.shape}, or a number that is not finite; expected one state ({n_inputs},)")
    if not box.contains(state).all():
        raise ValueError(f"x is {state.tolist()}, which is not in the domain {box!r}; give one that holds it")
    widths = np.ones(n_inputs) if scales is None else np.asarray(scales, dtype=np.float64)
    if widths.shape != state.shape or not (np.isfinite(widths) & (widths > 0)).all():
        raise ValueError(f"scales are {widths.tolist()}, expected {n_inputs} finite numbers above 0")
    return state, widths, box


def _passed(paths: Paths, place: Place, x: FloatArray, scales: FloatArray, names: Sequence[str]) -> PassedTest:
    form = paths.test(place)
    assert form is not None
    shown = form[:-1].copy()
    order = np.argsort(-np.abs(shown * scales), kind="stable")
    n_more = int((shown[order[_MOST_TERMS:]] != 0).sum())
    shown[order[_MOST_TERMS:]] = 0.0
    text = affine_expression(shown, form[-1], names, "{:.4g}".format, times=" ", tie=" ", leaves_out_ones=True)
    more = f" + {n_more} more terms" if n_more else ""
    return PassedTest(paths.node(place), f"{text}{more} <= 0", float(form[:-1] @ x + form[-1]))


def _in_words(answer: Any, answers: Sequence[str]) -> str:
    if np.ndim(answer) == 0:
        return label_name(int(answer), answers)
    return ", ".join(f"{name} = {value:.4g}" for name, value in zip(answers, np.asarray(answer).tolist(), strict=True))


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
