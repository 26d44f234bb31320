"""Why a tree answers as it does at a state: the tests passed, the leaf's map, and what would change the answer."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from otr.clock import time_limit
from otr.core.arrays import FloatArray, as_states
from otr.core.domain import Box, Domain, as_domain
from otr.core.head import Head
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree
from otr.explanation.nearest import nearest_state
from otr.explanation.paths import path_of, paths_of
from otr.programs.names import label_name, shown_names
from otr.programs.walk import affine_expression

_MOST_TERMS = 8  # of a line; the others are counted


@dataclass(frozen=True)
class PassedTest:
    """A test on a state's path: ``... <= 0`` in the inputs' names, and ``P @ x + v``, in the test's units.

    `node` is its number in the tree, None for a test of the head or of a network's hidden neuron.
    """

    node: int | None
    text: str
    margin: float


@dataclass(frozen=True)
class Nearest:
    """The nearest state of another leaf or label, at ``distance = |(state - x) / scales|`` (Euclidean)."""

    state: FloatArray  # (d,)
    distance: float
    leaf: int
    answer: Any
    text: str  # the answer in words


@dataclass(frozen=True)
class Explanation:
    """What `explain` returns; ``print`` shows it.

    Attributes:
        state: x, (d,).
        leaf: its number; of a `PatternTree` with all paths, the number whose bits are the path.
        answer, text: the answer as `predict` has it, and as text.
        tests: the tests passed, the root first.
        weights, constants, outputs: of the leaf's map, outputs = weights @ x + constants: (o, d), (o,) and (o,).
        shares: weights * x, what each input adds to each output: (o, d).
        head: what makes the answer of the outputs, as text.
        nearest_leaf, nearest_label: None where there is none, or where answers are no labels.
        feature_names, output_names: of inputs and outputs.
    """

    state: FloatArray
    leaf: int
    answer: Any
    text: str
    tests: tuple[PassedTest, ...]
    weights: FloatArray
    constants: FloatArray
    outputs: FloatArray
    shares: FloatArray
    head: str
    nearest_leaf: Nearest | None
    nearest_label: Nearest | None
    feature_names: tuple[str, ...]
    output_names: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON-ready data."""
        return dict(json.loads(json.dumps(asdict(self), default=lambda v: v.tolist())))

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"leaf {self.leaf}: {self.text}"
        for test in self.tests:
            yield f"  {test.text}: {'yes' if test.margin <= 0 else 'no'}, {test.margin:.4g}"
        for o, name in enumerate(self.output_names):
            if np.ndim(self.answer) == 0 and not self.weights[o].any():
                continue  # the score of a label, the same all over the leaf
            yield f"{name} = {self.outputs[o]:.4g}, the sum of"
            most, others = _largest(self.shares[o])
            for i in most:
                factors = f"{self.weights[o, i]:.4g} times {self.state[i]:.4g}"
                yield f"  {self.shares[o, i]:+.4g}  {self.feature_names[i]} ({factors})"
            if others:
                yield f"  {self.shares[o, others].sum():+.4g}  {len(others)} more inputs"
            yield f"  {self.constants[o]:+.4g}  constant"
        yield f"head: {self.head}"
        for what, found in (("leaf", self.nearest_leaf), ("label", self.nearest_label)):
            if found is not None:
                most, others = _largest(found.state - self.state)
                moves = [f"{self.feature_names[i]} {self.state[i]:.4g} -> {found.state[i]:.4g}" for i in most]
                moves += [f"{len(others)} more"] * bool(others)
                yield f"nearest state of another {what}, {found.distance:.4g} away: {', '.join(moves)}"
                yield f"  leaf {found.leaf}: {found.text}"


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

    A nearest state clears every test on its path by 1e-9 of the scales and of x's size, and no state that does is
    nearer. It is found best first over all paths, which for a wide `PatternTree` may take long.

    Args:
        tree: any tree, also what `parse_program` reads; of a network too wide for a tree, its `PatternTree`.
        x: one state (d,).
        feature_names, output_names: as in `to_text`.
        scales: (d,), what counts as a move by 1 in each input, such as ``states.std(axis=0)``; None is 1.
        domain: where a nearest state may be; None is all of R^d.
        max_seconds: refuse to look for longer.

    Raises:
        TypeError: `tree` is none.
        ValueError: x is no single finite state, or not in the domain, a scale is not above 0, or names do not fit.
        TimeLimitError: `max_seconds` were over.

    Examples:
        >>> tree = otr.parse_program("if angle + 0.5 rate <= 0: 0 else: 1", ["angle", "rate"], labels=True)
        >>> otr.explain(tree, [0.2, -0.1]).nearest_label.state.round(3)
        array([ 0.08, -0.16])
    """
    paths, policy = paths_of(tree), tree.network if isinstance(tree, PatternTree) else tree
    names, answers = shown_names(policy, feature_names, output_names)
    state, widths, box = _checked(x, scales, domain, tree.n_inputs)
    *passed, end = path_of(paths, state)
    (leaf, forms), answer, decided = paths.end(end), tree.predict(state), getattr(policy, "labels", None) is not None
    with time_limit(max_seconds, lambda: "the nearest states of another leaf and label were not found"):
        of_leaf, of_label = _nearest(tree, state, widths, box, answers)
    return Explanation(
        state=state,
        leaf=leaf,
        answer=answer,
        text=_in_words(answer, answers),
        tests=tuple(_passed(place, paths.test(place), state, widths, names) for place in passed),
        weights=forms[:, :-1],
        constants=forms[:, -1],
        outputs=forms @ np.append(state, 1.0),
        shares=forms[:, :-1] * state,
        head="the tests decide the label" if decided else policy.head.in_words(policy.n_outputs),
        nearest_leaf=of_leaf,
        nearest_label=of_label,
        feature_names=tuple(names),
        output_names=outputs_named(policy.head, policy.n_outputs, answers),
    )


def outputs_named(head: Head, n_outputs: int, answers: Sequence[str]) -> tuple[str, ...]:
    """Return names of the outputs: the answers', but for terms and gains, `Sign`, and labels without names."""
    are_named = len(answers) == n_outputs and list(answers) != [str(i) for i in range(n_outputs)]
    usual = answers if are_named else [f"y{i}" for i in range(n_outputs)]
    return tuple(head.output_names(n_outputs, answers) or usual)


def _nearest(
    tree: ObliqueTree | PatternTree, state: FloatArray, scales: FloatArray, domain: Domain, answers: Sequence[str]
) -> tuple[Nearest | None, Nearest | None]:
    """Return the nearest state of another leaf, and of another label where answers are labels."""
    paths, answer = paths_of(tree), tree.predict(state)

    def leaf_of(s: FloatArray) -> int:
        return paths.end(path_of(paths, s)[-1])[0]

    def found(wanted: Callable[[FloatArray], bool]) -> Nearest | None:
        nearest = nearest_state(paths, state, wanted, scales, domain)
        if nearest is None:
            return None
        distance, answered = float(np.linalg.norm((nearest - state) / scales)), tree.predict(nearest)
        return Nearest(nearest, distance, leaf_of(nearest), answered, _in_words(answered, answers))

    leaf = leaf_of(state)
    is_label = np.ndim(answer) == 0
    return found(lambda s: leaf_of(s) != leaf), found(lambda s: bool(tree.predict(s) != answer)) if is_label else None


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


def _passed(
    place: tuple[Any, ...], form: FloatArray | None, x: FloatArray, scales: FloatArray, names: Sequence[str]
) -> PassedTest:
    assert form is not None
    most, others = _largest(form[:-1] * scales)
    shown = np.zeros(len(x))
    shown[most] = form[most]
    text = affine_expression(shown, form[-1], names, "{:.4g}".format, times=" ", tie=" ", leaves_out_ones=True)
    more = f" + {len(others)} more terms" if others else ""
    node = place[0] if place and not isinstance(place[0], bool) and place[0] >= 0 else None
    return PassedTest(node, f"{text}{more} <= 0", float(form[:-1] @ x + form[-1]))


def _largest(values: FloatArray) -> tuple[list[int], list[int]]:
    """Return which numbers are shown, the largest first, and which others are not 0."""
    order = np.argsort(-np.abs(values), kind="stable")[: np.count_nonzero(values)].tolist()
    return order[:_MOST_TERMS], order[_MOST_TERMS:]


def _in_words(answer: Any, answers: Sequence[str]) -> str:
    if np.ndim(answer) == 0:
        return label_name(int(answer), answers)
    return ", ".join(f"{name} = {value:.4g}" for name, value in zip(answers, answer.tolist(), strict=True))
