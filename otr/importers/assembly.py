"""The network of a model that was cut into sections: its head, its layers with dense links, and the comparison."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, softmax

from otr.core.arrays import FloatArray
from otr.core.black_box import BlackBox
from otr.core.head import Head
from otr.core.heads import Argmax, Identity, Sign, TanhBox
from otr.core.network import Dense, ReluNetwork
from otr.core.smooth_network import Layered, SmoothNetwork
from otr.errors import InvalidNetworkError
from otr.importers.relu_units import DECISIONS, Form, Neurons, Source, neurons
from otr.importers.sections import LIMIT_NUMBERS, RANDOM, Sections, refuse_others, too_large

Function = Callable[[FloatArray], NDArray[Any]]
TRAIN_RELU = (
    "a tree needs ReLU or LeakyReLU: train with torch.nn.ReLU (in Stable-Baselines3, "
    "policy_kwargs=dict(activation_fn=torch.nn.ReLU))"
)
# Only where `read_policy` reads the policy
RELU_REMEDY = f"{TRAIN_RELU}, or imitate the policy, as otr-run method=augtree does"
_DECIDED_BY: dict[str, Head] = {"sigmoid": Sign(), "Softmax": Argmax(), "LogSoftmax": Argmax()}
_NAMES = {"tanh": "Tanh", "sigmoid": "Sigmoid", "clip": "Clip"}
_PROBES = 16  # states of each magnitude
_MAGNITUDES = (1e-3, 1.0, 1e3, 1e6)
_ROUNDING = 1e-11  # of the size of a sum's terms


def mappable(policy: Layered) -> ReluNetwork:
    """Return a policy of ReLU units, or raise InvalidNetworkError, which says what to do."""
    if isinstance(policy, SmoothNetwork):
        raise InvalidNetworkError(f"the units are {policy.activation}; {RELU_REMEDY}")
    return policy


def policy_of(
    sections: Sections,
    head: Head | None = None,
    *,
    decides: bool = False,
    answer: Callable[[FloatArray], NDArray[np.float64]] | None = None,
) -> ReluNetwork:
    """Return the network of a model, compared with what the model answers on states of several magnitudes.

    Args:
        sections: the model.
        head: from the outputs to the answer; None for the model's.
        decides: whether of probabilities the likelier label is the answer; else they need `head`.
        answer: of the model on one state (d,), flattened; None for that of its nodes.

    Raises:
        InvalidNetworkError: nodes that are neither affine nor units of a ReLU network, another head than `head`, a
            matrix that is too large, or another answer than the model's.
    """
    end = _ending(sections)
    network = _network(sections, end)
    network = network.replace(head=_head(end, network.n_outputs, head, decides))
    _require_same_answers(network, end.kind, answer or sections.answer)
    return network


@dataclass
class _End:
    """How the answer is made of a value: its form, a kind of head, and the answer's limits and, of a tanh, its box."""

    form: Form
    kind: str = ""
    half: FloatArray = field(default_factory=lambda: np.ones(1))
    middle: FloatArray = field(default_factory=lambda: np.zeros(1))
    low: FloatArray = field(default_factory=lambda: np.full(1, -math.inf))
    high: FloatArray = field(default_factory=lambda: np.full(1, math.inf))


def _ending(sections: Sections) -> _End:
    """Return the end of a model: the last cuts that its answer reads one by one, where a head is the same."""
    value, scale, shift = sections.output_name, np.ones(1), np.zeros(1)
    labels = _decision(sections, value)
    if labels is not None:
        return labels
    end = _End(sections.form(value))
    whole = end.form
    while (found := _elementwise(sections, end.form)) is not None:
        source, gains, offset = found
        unit = source.unit
        assert unit is not None
        scale, shift = scale * gains, shift + scale * offset
        plain = np.all(scale == 1) and not np.any(shift)
        if unit.kind in _DECIDED_BY and plain and end.kind == "":
            return _without_common(sections, _End(sections.form(source.read), unit.kind))
        if unit.kind == "tanh":
            end.half, end.middle, end.kind = np.abs(scale), shift, "tanh"
            end.form = _scaled(sections.form(source.read), np.sign(scale), np.zeros(1))
            return end
        if unit.low is None or unit.high is None:
            break
        limits = np.sort((scale * unit.low + shift, scale * unit.high + shift), axis=0)
        end.low, end.high = np.maximum(end.low, limits[0]), np.minimum(end.high, limits[1])
        end.kind, end.form = "clip", sections.form(source.read)
    if not (np.isfinite(end.low).all() and np.isfinite(end.high).all() and np.all(end.low < end.high)):
        return _End(whole)  # clips on one side, or other units, are neurons
    end.form = _scaled(end.form, scale, shift)
    return end


def _scaled(form: Form, scale: FloatArray, shift: FloatArray) -> Form:
    if np.all(scale == 1) and not np.any(shift):
        return form
    rows = np.broadcast_to(scale, len(form.offset))
    return Form({name: rows[:, None] * W for name, W in form.matrices.items()}, rows * form.offset + shift)


def _elementwise(sections: Sections, form: Form) -> tuple[Source, FloatArray, FloatArray] | None:
    """Return the one cut that a value is of, number by number, with gains and an offset; else None."""
    if len(form.matrices) != 1:
        return None
    ((name, W),) = form.matrices.items()
    source = sections.sources[name]
    if source.unit is None or W.shape[0] != W.shape[1]:
        return None
    gains = np.diag(W)
    is_diagonal = np.count_nonzero(W) == len(W) and np.all(gains != 0)
    return (source, gains, form.offset) if is_diagonal else None


def _decision(sections: Sections, value: str) -> _End | None:
    """Return the end of a model that answers a label: ArgMax, of numbers that a Softmax may have left in order."""
    source = _argmax(sections, value)
    if source is None:
        return None
    form = sections.form(source.read)
    while (found := _elementwise(sections, form)) is not None:
        before, gains, offset = found
        if before.unit is None or before.unit.kind not in DECISIONS or np.ptp(gains) or np.ptp(offset) or gains[0] < 0:
            break
        form = sections.form(before.read)
    return _without_common(sections, _End(form, "ArgMax"))


def _argmax(sections: Sections, value: str) -> Source | None:
    """Return the ArgMax that makes a value; None for a value of real numbers."""
    names = [value] if value in sections.sources else sections._section(value)[1]
    source = sections.sources[names[0]]
    if len(names) != 1 or source.is_real or source.unit is None or source.unit.kind != "ArgMax":
        return None
    n_labels = sections.size(source.read)
    if value != source.name and sections.labels_after(source, value, n_labels) != [[k] for k in range(n_labels)]:
        raise InvalidNetworkError(f"{_name(source)} is followed by more than a shape; export the label itself")
    return source


def black_box(
    sections: Sections,
    runtime: Callable[[str], tuple[Function, Function]],
    reason: str,
    content: bytes,
    suffix: str,
    output: str | None = None,
) -> BlackBox:
    """Return a model that is no ReLU network: its sections give how it decides.

    Args:
        sections: the model.
        runtime: from the name of a value to functions that compute it, for one state (d,) and for several (n, d).
        reason, content, suffix, output: as `BlackBox` has them.

    Raises:
        InvalidNetworkError: it answers differently every time, whole numbers that are no ArgMax, or numbers that are
            not finite; or it cannot run.
    """
    value = sections.output_name
    head: Head = Identity()
    if (labels := _argmax(sections, value)) is not None:
        value, head = labels.read, Argmax()
    elif not sections.is_real(value):
        raise InvalidNetworkError(
            "the model answers with whole numbers that are no argmax of its outputs; export it with the numbers that "
            "decide as its answer"
        )
    while value in sections.sources and (unit := sections.sources[value].unit) and unit.kind in DECISIONS:
        value, head = sections.sources[value].read, Argmax()
    one, several = runtime(value)
    n_inputs, width = sections.input.width, sections.size(value)
    probes = np.random.default_rng(0).standard_normal((3, n_inputs))
    try:
        expected, again = ([one(probe).ravel() for probe in probes] for _ in "ab")
    except Exception as error:  # foreign code can fail in any way
        raise InvalidNetworkError(f"the model cannot be run on a state of {n_inputs} numbers: {error}") from error
    if not np.array_equal(expected, again, equal_nan=True):
        raise InvalidNetworkError(f"the model {RANDOM}")
    try:
        is_same = np.allclose(several(probes).reshape(len(probes), width), expected, rtol=1e-4, atol=1e-6)
    except Exception:  # it may have the shape of one state in it
        is_same = False

    def run(X: FloatArray) -> FloatArray:
        return several(X) if is_same else np.stack([one(x).ravel() for x in X])

    policy = BlackBox(run, n_inputs, width, _first_layer(sections), reason, content, suffix, output, head=head)
    policy.forward(probes)
    return policy


def _first_layer(sections: Sections) -> FloatArray:
    """Return rows [weights | offset] of what the first cuts read; the states themselves where that cannot be read."""
    d, rows = sections.input.width, []
    for read in dict.fromkeys(source.read for source in sections.sources.values() if source.node is not None):
        if sections._section(read)[1] == [sections.input.name]:
            try:
                form = sections.form(read)
            except InvalidNetworkError:
                continue
            rows.append(np.column_stack((form.matrices.get(sections.input.name, np.zeros((0, d))), form.offset)))
    return np.concatenate(rows) if rows else np.eye(d, d + 1)


def _without_common(sections: Sections, end: _End) -> _End:
    """Drop what unknown cuts add to all outputs alike, such as a LogSumExp: the largest stays the largest."""
    if end.kind == "sigmoid":
        return end
    kept = {
        name: W
        for name, W in end.form.matrices.items()
        if name == sections.input.name or sections.sources[name].unit is not None or np.ptp(W, axis=0).any()
    }
    end.form = Form(kept, end.form.offset)
    return end


def _head(end: _End, width: int, given: Head | None, decides: bool) -> Head:
    """Return the head of an end, or the one that is given where it ends without, or raise InvalidNetworkError."""
    name = _NAMES.get(end.kind, end.kind)
    if end.kind in _DECIDED_BY:
        found = _DECIDED_BY[end.kind]
        if given != found and not (given is None and decides):
            raise InvalidNetworkError(
                f"the model ends in {name}; it needs head=otr.{type(found).__name__}(), as the tree answers with the "
                "label and not the probability"
            )
        return found
    if not end.kind:
        return Identity() if given is None else given
    low, high = (np.broadcast_to(limit, width) for limit in (end.low, end.high))
    try:
        if end.kind == "ArgMax":
            found = Argmax()
        elif end.kind == "clip":
            found = Identity().clipped_to(low, high)
        else:
            box = np.broadcast_arrays(end.middle - end.half, end.middle + end.half, low)[:2]
            found = TanhBox(-1.0, 1.0) if np.all(end.half == 1) and not np.any(end.middle) else TanhBox(*box)
            if np.isfinite(low).any() or np.isfinite(high).any():
                found = found.clipped_to(low, high)
    except ValueError as error:
        raise InvalidNetworkError(str(error)) from error
    if given not in (None, found):
        raise InvalidNetworkError(f"head is {given!r}, the model ends in {name}: {found!r}; leave head out")
    return found


def _network(sections: Sections, end: _End) -> ReluNetwork:
    forms = _forms(sections, end.form)
    cuts = [sections.sources[name] for name in sections.sources if name in forms]
    refuse_others(cuts)
    units = {cut.name: cut.unit for cut in cuts if cut.unit is not None}
    slopes = {float(value) for unit in units.values() for value in (unit.slope if unit.slope is not None else (9.0,))}
    slope = slopes.pop() if len(slopes) == 1 else -1.0
    is_plain = 0 <= slope < 1
    parts = {cut.name: _as_they_are(cut.width) if is_plain else neurons(units[cut.name], cut.width) for cut in cuts}
    weights, biases, dense = _layers(sections.input, end.form, forms, parts)
    return ReluNetwork(weights, biases, negative_slope=slope if is_plain and cuts else 0.0, dense=dense)


def _forms(sections: Sections, last: Form) -> dict[str, Form]:
    """Return what every cut reads that the last form is made of, in the order of the graph."""
    forms: dict[str, Form] = {}
    open_forms = [last]
    while open_forms:
        names = [name for name in open_forms.pop().matrices if name != sections.input.name and name not in forms]
        refuse_others(map(sections.sources.__getitem__, names))
        forms |= {name: sections.form(sections.sources[name].read) for name in names}
        open_forms += [forms[name] for name in names]
    return {name: forms[name] for name in sections.sources if name in forms}


def _as_they_are(width: int) -> Neurons:
    return Neurons(np.arange(width), np.ones(width), np.zeros(width), np.ones(width), np.zeros(width))


def _layers(
    x: Source, last: Form, forms: dict[str, Form], parts: dict[str, Neurons]
) -> tuple[list[FloatArray], list[FloatArray], Dense]:
    """Return weights, biases and the dense links of a network.

    A cut's neurons belong to the layer after the latest of those that it reads.
    """
    layer_of = {x.name: 0}
    for name, form in forms.items():
        layer_of[name] = 1 + max((layer_of[read] for read in form.matrices), default=0)
    widths = {x.name: x.width} | {name: len(part.rows) for name, part in parts.items()}
    names: list[list[str]] = [
        [name for name in forms if layer_of[name] == 1 + k] for k in range(max(layer_of.values()))
    ]
    rows = [[_of_neurons(_reading(forms[name], parts), parts[name]) for name in layer] for layer in names]
    rows.append([_reading(last, parts)])
    links = {
        (layer_of[name], layer)
        for layer, made in enumerate(rows)
        for form in made
        for name, W in form.matrices.items()
        if W.any()
    }
    is_all = any(0 < read < layer for read, layer in links)
    dense: Dense = "all" if is_all else "input" if any(read == 0 < layer for read, layer in links) else False
    weights, biases = [], []
    for layer, made in enumerate(rows):
        read = [name for each in names[0 if is_all else max(layer - 1, 0) : layer] for name in each]
        read += [x.name] if layer == 0 or dense is not False else []
        height, width = sum(len(form.offset) for form in made), sum(widths[name] for name in read)
        if height * width > LIMIT_NUMBERS:
            raise InvalidNetworkError(too_large(height, width))
        blocks = [
            [form.matrices.get(name, np.zeros((len(form.offset), widths[name]))) for name in read] for form in made
        ]
        weights.append(np.block(blocks))
        biases.append(np.concatenate([form.offset for form in made]))
    return weights, biases, dense


def _reading(form: Form, parts: dict[str, Neurons]) -> Form:
    """Return a form of the units' neurons instead of the units."""
    matrices, offset = dict(form.matrices), form.offset
    for name, part in parts.items():
        if name in matrices:
            offset = offset + matrices[name] @ part.offset
            matrices[name] = matrices[name][:, part.rows] * part.gains
    return Form(matrices, offset)


def _of_neurons(form: Form, part: Neurons) -> Form:
    matrices = {name: part.signs[:, None] * W[part.rows] for name, W in form.matrices.items()}
    return Form(matrices, part.signs * form.offset[part.rows] + part.shifts)


def probe_states(n_inputs: int, n_states: int = 64) -> FloatArray:
    """Return fixed states of several magnitudes, `n_states` of each, and the origin: (n, n_inputs)."""
    rng = np.random.default_rng(0)
    states = [magnitude * rng.standard_normal((n_states, n_inputs)) for magnitude in _MAGNITUDES]
    return np.concatenate((np.zeros((1, n_inputs)), *states))


def reach(policy: Layered, states: FloatArray) -> FloatArray:
    """Return the size (n, o) of the terms that make up each output, to which rounding is in proportion."""
    weights, biases = [np.abs(W) for W in policy.weights], [np.abs(b) for b in policy.biases]
    if isinstance(policy, SmoothNetwork):  # a smooth unit of z is at most |z| + 1
        biases = [b + 1 for b in biases]
        return ReluNetwork(weights, biases).forward(np.abs(states))
    return ReluNetwork(weights, biases, dense=policy.dense).forward(np.abs(states))


def _require_same_answers(policy: ReluNetwork, kind: str, answer: Callable[[FloatArray], NDArray[np.float64]]) -> None:
    """Raise InvalidNetworkError where the model's answers differ from the network's, beyond rounding."""
    n_states = max(1, min(_PROBES, 2**20 // policy.n_inputs))
    states = probe_states(policy.n_inputs, n_states)
    outputs, sizes = policy.forward(states), reach(policy, states).max(axis=1)
    # Logarithms are compared as probabilities: onnx's reference has -inf for the small ones.
    after = {"sigmoid": expit, "Softmax": softmax, "LogSoftmax": softmax, "tanh": policy.head, "clip": policy.head}
    limits = policy.head.limits(policy.n_outputs)
    gain = 1.0 if limits is None else max(1.0, float(np.max(limits[1] - limits[0])))
    for state, y, size in zip(states, outputs, sizes, strict=True):
        try:
            with np.errstate(all="ignore"):
                found = np.asarray(answer(state))
                found = np.exp(found) if kind == "LogSoftmax" else found
        except Exception as error:  # foreign code can fail in any way
            raise InvalidNetworkError(f"the model cannot be run on the state {state.tolist()[:20]}: {error}") from error
        limit = _ROUNDING * gain * (size + 1)
        if kind == "ArgMax":
            same = found.size == 1 and 0 <= int(found[0]) < len(y) and y.max() - y[int(found[0])] <= limit
        else:
            expected = after[kind](y) if kind else y
            same = found.shape == expected.shape and bool(np.all(np.abs(found - expected) <= limit))
        if not same:
            raise InvalidNetworkError(
                f"the model answers differently from its layers: in state {state.tolist()[:20]} it gives "
                f"{found.tolist()[:20]}, its layers {y.tolist()[:20]}; an operation between activations is not affine"
            )


def _name(source: Source) -> str:
    return source.node.name if source.node else source.name
