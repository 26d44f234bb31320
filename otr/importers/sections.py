"""A model as a graph: nonlinear nodes cut it into sections, and each section is the affine map that it evaluates to.

Every node is run in float64 on one state, whatever operator it is. Where three points with r = 2 p - q show that a
node's answer is no affine function of what it reads, it is a cut, which `otr.importers.relu_units` recognises. Both q
and -q are tried, so that the points of a scale are on both sides of zero, and so are weighted sums of them: at a scale
beyond its limits, no clip has them all on one side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray
from otr.errors import InvalidNetworkError, OtrError
from otr.importers.relu_units import Form, Node, Source, Unit, recognised

LIMIT_NUMBERS = 2**24  # of a matrix: a product of thin ones can be far larger than the file
_LIMIT_WIDTH = 2**20  # of a value: a file of a hundred bytes can declare any number of inputs
_LIMIT_HELD = 2**26  # of all values together, on all points
_LIMIT_WORK = 2**28  # numbers that are computed for the matrix of a section
_SCALES = tuple(2.0**power for power in (-10, 0, 10, 20, 50, 700))  # of the points on which nodes are tried
_N_POINTS = 5  # of each scale: p, q, -q, 2 p - q, 2 p + q
# A basis vector of this length swamps what a section adds, so that (f(length * e) - f(0)) / length has the stored bits.
_LENGTH = 2.0**700
_LIMIT_ROWS = 256  # basis vectors at a time
_N_BACK = 8  # nodes in which one unit may be written
IMITATE = "train with these, or let a tree imitate the model as it is: otr.imitate(otr.read_policy(model), env)"
MEMORY = "{} remembers earlier states, and a tree answers the present one; use a policy without memory"
RANDOM = "answers differently every time; export the deterministic policy, of torch after module.eval()"
NOT_FINITE = "a weight or bias is not finite (NaN or infinite); give a policy from before the training diverged"
_TOLERANCE, _NOISE = 1e-6, 1e-12  # of a node's answer, and of what it reads


class Sections:
    """The graph of a model, from one state to one answer.

    Attributes:
        sources: the states first, then the cuts in the order in which they are computed.
        output_name: of the answer.
    """

    def __init__(
        self,
        input_name: str,
        shape: tuple[int, ...],
        nodes: Iterable[Node],
        constants: dict[str, Any],
        output_name: str,
    ) -> None:
        """Run the nodes, each one after those that it reads; what they make of constants is added to `constants`.

        `shape` is (n, ...) or (number of inputs,); an open size is 0.

        Raises:
            InvalidNetworkError: another shape, too many numbers, a node that fails, or an answer without states.
        """
        self.output_name, self.constants = output_name, constants
        self.sources: dict[str, Source] = {}
        self._points: dict[str, list[NDArray[Any]]] = {}
        self._labels: dict[str, Source] = {}  # values that are made of such a source, which is not real
        self._live: list[Node] = []
        self._n_held = 0
        self._rng = np.random.default_rng(0)
        if not shape or not all(shape[1:]) or shape == (0,):
            shown = ", ".join(str(size or "?") for size in shape)
            raise InvalidNetworkError(
                f"the input {str(input_name)!r} has the shape ({shown}), expected (n, number of inputs), of which n "
                "alone may be left open, or (number of inputs,); export it again with states of this shape"
            )
        shape = (1, *shape[1:]) if len(shape) > 1 else shape
        _require_width(math.prod(shape))
        self._add(Source(input_name, shape))
        for node in nodes:
            try:
                self._trace(node)
            except OtrError as error:
                if node.name in str(error):
                    raise
                raise InvalidNetworkError(f"{node.name} {error}") from error
            except Exception as error:  # foreign operators can fail in any way on foreign numbers
                if read := [self._labels[name] for name in node.inputs if name in self._labels]:
                    raise InvalidNetworkError(_refusal(*read)) from error
                shapes = [np.shape(self._points[name][0]) if name in self._points else np.shape(constants[name])
                          for name in node.inputs if name]  # fmt: skip
                problem = str(error).strip().rpartition("] ")[2]
                raise InvalidNetworkError(f"{node.name} cannot be run on the shapes {shapes}: {problem}") from error
        if output_name not in self._points:
            raise InvalidNetworkError(f"{output_name!r} is not computed from {input_name!r}")
        self.input = next(iter(self.sources.values()))

    @classmethod
    def of_steps(
        cls,
        steps: Sequence[tuple[str, Callable[[NDArray[Any]], NDArray[Any]]]],
        n_inputs: int,
        matrices: dict[int, FloatArray] | None = None,
    ) -> Sections:
        """Return the sections of named functions, each of which reads what the one before it makes: (1, n) arrays.

        `matrices` are those that steps are likely to multiply by.
        """
        constants = {f"matrix {k}": matrix for k, matrix in (matrices or {}).items()}

        def node(k: int, name: str, step: Callable[[NDArray[Any]], NDArray[Any]]) -> Node:
            read = (f"value {k}", *(each for each in (f"matrix {k}",) if each in constants))
            return Node(name, read, (f"value {k + 1}",), lambda given: [step(given[0])])

        nodes = [node(k, name, step) for k, (name, step) in enumerate(steps)]
        return cls("value 0", (1, n_inputs), nodes, constants, f"value {len(nodes)}")

    def size(self, value: str) -> int:
        """Return how many numbers a value has."""
        return int(self._points[value][0].size)

    def is_real(self, value: str) -> bool:
        """Return whether a value's numbers are real, and no labels."""
        return self._points[value][0].dtype.kind == "f"

    def form(self, value: str) -> Form:
        """Return the affine map of the section that makes a value.

        Raises:
            InvalidNetworkError: its matrix is too large, or it is no affine map.
        """
        nodes, names = self._section(value)
        for name in names:
            if not self.sources[name].is_real:
                raise InvalidNetworkError(_refusal(self.sources[name]))
            self._require_moderate(nodes, value, self.sources[name].width)
        try:
            made = self._stored(nodes, value, names)
            if made is None:  # many basis vectors at a time, where the nodes take several states
                made = self._measured(nodes, value, names, _LIMIT_ROWS)
        except Exception:  # foreign operators can fail in any way on more states than the graph is of
            made = None
        if made is None or not self._holds(made, nodes, value, names):
            made = self._measured(nodes, value, names, 1)
            if not self._holds(made, nodes, value, names):
                listed = ", ".join(node.name for node in nodes[:8])
                raise InvalidNetworkError(
                    f"what makes {value!r} is not affine ({listed}): between activations only affine operations can be "
                    "read"
                )
        return made

    def _stored(self, nodes: list[Node], value: str, names: list[str]) -> Form | None:
        """Return the map of a section whose matrix is one of the constants that it reads; None where none is."""
        if len(names) != 1:
            return None
        source = self.sources[names[0]]
        offset = self._evaluated(nodes, value, {source.name: np.zeros(source.shape)})
        constants = [self.constants[name] for node in nodes for name in node.inputs if name in self.constants]
        found = [each for each in constants if np.ndim(each) == 2 and np.asarray(each).dtype.kind == "f"]
        for W in (W for each in found for W in (each, each.T) if W.shape == (len(offset), source.width)):
            # Points of whole numbers, of which products and most sums are exact
            points = self._rng.integers(-8, 9, (4, source.width)).astype(np.float64)
            size = np.abs(W).sum(axis=1).max() * 8 + np.abs(offset).max()
            answers = [self._evaluated(nodes, value, {source.name: point.reshape(source.shape)}) for point in points]
            if np.all(np.abs(points @ W.T + offset - answers) <= 1e-14 * size):
                return Form({source.name: np.array(W, dtype=np.float64)}, offset)
        return None

    def _measured(self, nodes: list[Node], value: str, names: list[str], n_rows: int) -> Form:
        """Return the map that a section's answers to zero and to basis vectors, `n_rows` at a time, show."""
        offset = self._evaluated(nodes, value, {name: np.zeros(self.sources[name].shape) for name in names})
        matrices: dict[str, FloatArray] = {}
        for name in names:
            source = self.sources[name]
            columns = np.empty((source.width, len(offset)))
            for start in range(0, source.width, n_rows):
                rows = columns[start : start + n_rows]
                given = {each: np.zeros((len(rows), self.sources[each].width)) for each in names}
                np.fill_diagonal(given[name][:, start:], _LENGTH)
                shaped = {each: self._stacked(self.sources[each].shape, given[each]) for each in names}
                moved = self._evaluated(nodes, value, shaped, len(rows)).reshape(rows.shape)
                rows[:] = (moved - offset) / _LENGTH
            if columns.any() or source.unit is not None:  # a layer of zeros keeps the layer before it
                matrices[name] = np.ascontiguousarray(columns.T)
        return Form(matrices, offset)

    @staticmethod
    def _stacked(shape: tuple[int, ...], rows: FloatArray) -> FloatArray:
        """Return rows (k, width) as k states of a shape (1, ...), or a single one in its shape."""
        if len(rows) > 1 and (len(shape) < 2 or shape[0] != 1):
            raise ValueError(f"values of the shape {shape} are of one state alone")
        return rows.reshape(shape if len(rows) == 1 else (len(rows), *shape[1:]))

    def answer(self, state: FloatArray, value: str = "") -> NDArray[Any]:
        """Return what the nodes make of one state, cuts and all, flattened: the answer, or another value."""
        values: dict[str, Any] = {self.input.name: state.reshape(self.input.shape)}
        for node in self._live:
            values.update(zip(node.outputs, self._run(node, values), strict=False))
        return np.asarray(values[value or self.output_name]).ravel()

    def labels_after(self, source: Source, value: str, n_labels: int) -> list[Any]:
        """Return what the nodes after a decision make of each label."""
        nodes, _ = self._section(value)
        given = (np.full(source.shape, label, dtype=np.int64) for label in range(n_labels))
        return [self._evaluated(nodes, value, {source.name: label}).tolist() for label in given]

    def _trace(self, node: Node) -> None:
        live = [name for name in dict.fromkeys(node.inputs) if name in self._points]
        if not live or node.reads_shape:
            values = {name: points[0] for name, points in self._points.items() if name in live}
            made = self._run(node, values)
            again = self._run(node, values)
            for name, value, other in zip(node.outputs, made, again, strict=False):
                if not np.array_equal(value, other, equal_nan=np.asarray(value).dtype.kind == "f"):
                    raise InvalidNetworkError(RANDOM)
                self.constants[name] = value
                self._hold(np.size(value))
            return
        self._live.append(node)
        labels = [self._labels[read] for read in live if read in self._labels]
        made, affine = self._tried(node, live, are_real=not labels)
        for i, name in enumerate(node.outputs):
            if not name or i >= len(made[0]):
                continue
            answers = [results[i] for results in made]
            is_real = answers[0].dtype.kind == "f"
            _require_width(answers[0].size)
            self._hold(_N_POINTS * len(_SCALES) * answers[0].size)
            if i in affine:
                if all(np.array_equal(answers[0], other) for other in answers):
                    self._require_each_state(node, live, i, answers[0])
                self._points[name] = answers
                continue
            if labels and (not is_real or labels[0].unit is not None):  # an ArgMax may be cast to real numbers
                self._labels[name] = labels[0]
                self._points[name] = answers[:1] * (_N_POINTS * len(_SCALES))
                continue
            read, unit = self._unit(node, i)
            if unit is None:
                self._require_finite(node, answers)
                again = self._run(node, {name: self._points[name][0] for name in live})[i]
                if not np.array_equal(answers[0], again, equal_nan=is_real):
                    raise InvalidNetworkError(RANDOM)
            named = labels[0].node if labels and unit is None else node
            self._add(Source(name, answers[0].shape, named, read, unit, is_real), answers[0])

    def _tried(self, node: Node, live: list[str], *, are_real: bool) -> tuple[list[list[NDArray[Any]]], set[int]]:
        """Return a node's answers on the points, and which outputs are affine; the points end where none is."""
        made: list[list[NDArray[Any]]] = []
        affine = set(range(len(node.outputs))) if are_real else set()
        for start in range(0, _N_POINTS * len(_SCALES), _N_POINTS):
            points = [{name: self._points[name][start + k] for name in live} for k in range(_N_POINTS)]
            noise = max(float(np.abs(each).max(initial=0)) for point in points for each in point.values())
            with np.errstate(all="ignore"):
                tried = [[np.asarray(each) for each in self._run(node, point)] for point in points]
            affine = {i for i in affine if i < len(tried[0]) and _is_affine([results[i] for results in tried], noise)}
            made += tried
            if not affine:
                break
        return made, affine

    def _require_finite(self, node: Node, answers: list[NDArray[Any]]) -> None:
        """Raise InvalidNetworkError where weights or biases are not finite; -inf alone may be a mask."""
        if any(np.isnan(each).any() or np.isposinf(each).any() for each in answers if each.dtype.kind == "f"):
            for name in node.inputs:
                values = np.asarray(self.constants.get(name, 0.0))
                if values.dtype.kind == "f" and not np.isfinite(values).all():
                    raise InvalidNetworkError(f"{node.name} reads {name!r}: {NOT_FINITE}")

    def _require_each_state(self, node: Node, live: list[str], output: int, made: NDArray[Any]) -> None:
        """Raise InvalidNetworkError where a node answers one state always the same, and two states differently."""
        both = {
            name: np.concatenate(self._points[name][:2]) for name in live if self._points[name][0].shape[:1] == (1,)
        }
        try:
            found = np.asarray(self._run(node, both)[output]) if len(both) == len(live) else made
        except Exception:  # it may have the shape of one state in it
            return
        if found.shape == (2, *made.shape[1:]) and made.ndim and not np.array_equal(found, np.concatenate([made] * 2)):
            raise InvalidNetworkError("goes over the states, expected each state's numbers: choose the last axis")

    def _unit(self, node: Node, output: int) -> tuple[str, Unit | None]:
        """Return the unit that an output of a node is, and the value that it is of; (first input, None) if none is.

        A unit may be written in several nodes, such as z * sigmoid(z): values up to `_N_BACK` nodes before are
        tried.
        """
        live = [name for name in node.inputs if name in self._points]
        values = [name for each in reversed(self._live[-_N_BACK:]) for name in each.inputs if name in self._points]
        for read in dict.fromkeys([*live, *values]):
            nodes, given = self._between(read, node), self._points[read][0]
            if not nodes or given.dtype.kind != "f":
                continue

            def answer(z: FloatArray, nodes: list[Node] = nodes, read: str = read) -> NDArray[Any]:
                values: dict[str, Any] = {read: z.reshape(self._points[read][0].shape)}
                for each in nodes:
                    made = self._run(each, values)
                    values.update(zip(each.outputs, made, strict=False))
                return np.asarray(made[output]).ravel()

            unit = recognised(answer, given.size, self._rng)
            if unit is not None:
                return read, unit
        return live[0], None

    def _between(self, read: str, node: Node) -> list[Node]:
        """Return the nodes that make a node's answer of one value alone; none where it reads more."""
        nodes, wanted = [node], {name for name in node.inputs if name in self._points} - {read}
        for each in reversed(self._live[-_N_BACK:-1]):
            if wanted.intersection(each.outputs):
                nodes.append(each)
                wanted |= {name for name in each.inputs if name in self._points}
                wanted -= {*each.outputs, read}
        return [] if wanted else nodes[::-1]

    def _add(self, source: Source, made: NDArray[Any] | None = None) -> None:
        """Let sections read a source: on points of its own where its numbers are real, else on one of those made."""
        points: list[Any] = []
        for scale in _SCALES:
            p, q = (scale * self._rng.standard_normal(source.shape) for _ in "pq")
            points += [p, q, -q, 2 * p - q, 2 * p + q] if source.is_real else [made] * _N_POINTS
        self.sources[source.name], self._points[source.name] = source, points
        if not source.is_real:
            self._labels[source.name] = source

    def _hold(self, n_numbers: int) -> None:
        self._n_held += n_numbers
        if self._n_held > _LIMIT_HELD:
            raise InvalidNetworkError(
                f"is where the values of all nodes have {self._n_held:,} numbers, the limit is {_LIMIT_HELD:,}"
            )

    def _run(self, node: Node, values: dict[str, Any]) -> list[Any]:
        operands = []
        for name in node.inputs:
            if name and name not in values and name not in self.constants:
                raise InvalidNetworkError(f"reads {name!r}, which is no value")
            operands.append(values[name] if name in values else self.constants[name] if name else None)
        return list(node.run(operands))

    def _section(self, value: str) -> tuple[list[Node], list[str]]:
        """Return the nodes between the last cuts and a value, in order, and the sources that they read."""
        wanted, nodes = {value}, []
        for node in reversed(self._live):
            if any(name in wanted and name not in self.sources for name in node.outputs):
                nodes.append(node)
                wanted.update(name for name in node.inputs if name in self._points)
        return nodes[::-1], [name for name in self.sources if name in wanted]

    def _evaluated(self, nodes: list[Node], value: str, given: dict[str, Any], n_states: int = 1) -> FloatArray:
        values = dict(given)
        with np.errstate(all="ignore"):
            for node in nodes:
                made = zip(node.outputs, self._run(node, values), strict=False)
                values.update((name, result) for name, result in made if name not in given)
        answer = np.array(values[value], dtype=np.float64)
        if n_states > 1 and answer.shape[:1] != (n_states,):
            raise ValueError(f"{n_states} states have answers of the shape {answer.shape}")
        return answer.ravel()

    def _require_moderate(self, nodes: list[Node], value: str, width: int) -> None:
        size = self._points[value][0].size
        if size * width > LIMIT_NUMBERS:
            raise InvalidNetworkError(too_large(size, width))
        work = width * sum(self._points[name][0].size for node in nodes for name in node.outputs if name)
        if work > _LIMIT_WORK:
            raise InvalidNetworkError(
                f"{value!r} takes {width:,} evaluations of {len(nodes)} nodes, {work:,} numbers in all; the limit is "
                f"{_LIMIT_WORK:,}: a network of this size has no tree that can be held"
            )

    def _holds(self, form: Form, nodes: list[Node], value: str, names: list[str]) -> bool:
        """Return whether a section answers a random point as its matrices do."""
        given = {name: self._rng.standard_normal(self.sources[name].shape) for name in names}
        expected, size = form.offset, np.abs(form.offset)
        for name, W in form.matrices.items():
            expected = expected + W @ given[name].ravel()
            size = size + np.abs(W) @ np.abs(given[name].ravel())
        found = self._evaluated(nodes, value, given)
        return bool(np.all(np.abs(found - expected) <= 1e-9 * (size.max(initial=0) + 1e-300)))


def refuse_others(sources: Iterable[Source]) -> None:
    """Raise InvalidNetworkError that names the cuts that are no units of a ReLU network, if there are any."""
    others = [
        source
        for source in sources
        if source.node is not None and (source.unit is None or source.unit.kind not in ("slope", "clip"))
    ]
    if others:
        raise InvalidNetworkError(_refusal(*others))


def too_large(rows: int, columns: int) -> str:
    """Return the message for a matrix above the limit."""
    return (
        f"the model makes a matrix of {rows} x {columns} numbers, the limit is {LIMIT_NUMBERS:,}; a network of this "
        "width has no tree that can be held"
    )


def _refusal(*sources: Source) -> str:
    listed = ", ".join(source.node.name for source in sources[:5] if source.node)
    return (
        f"{listed} {'is' if len(sources) == 1 else 'are'} not affine, and no unit of a ReLU network; between affine "
        "operations of any kind there may be ReLU, LeakyReLU, PReLU, Abs, and Clip, Max and Min with constants, at the "
        f"end Tanh or ArgMax, and each sees the numbers of one state; {IMITATE}"
    )


def _require_width(width: int) -> None:
    if width > _LIMIT_WIDTH:
        raise InvalidNetworkError(
            f"there are {width:,} numbers for each state, the limit is {_LIMIT_WIDTH:,}; is it the right file?"
        )


def _is_affine(points: list[NDArray[Any]], noise: float) -> bool:
    if points[0].dtype.kind != "f":
        return False
    p, q, of_minus_q, below, above = points
    with np.errstate(all="ignore"):
        size = max(float(np.abs(each).max(initial=0)) for each in points)
        errors = np.abs(2 * p - q - below), np.abs(2 * p - of_minus_q - above)
        limit = _TOLERANCE * size + _NOISE * noise
        return bool(np.isfinite(size) and all(np.all(error <= limit) for error in errors))
