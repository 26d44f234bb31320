"""By how much a network's outputs can change when its inputs do: bounds over a box, in rational arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.domain import Domain
from otr.core.network import ReluNetwork
from otr.geometry.rational import ExactUnits

Fractions = NDArray[Any]  # of Fraction
_MOST = 10  # neurons whose patterns are counted


def largest_changes(
    network: ReluNetwork, domain: Domain, steps: Sequence[Fraction], differences: NDArray[np.int64]
) -> list[Fraction]:
    """Return bounds on the changes of differences of outputs, (m, o) @ y, between states of a box.

    On the way from a state to another the slopes are those of activation patterns. Of neurons that may be on both sides
    of 0 in the box all patterns count if these are few; else the slopes are bounded unit by unit, by intervals.

    Args:
        network, domain: the network and the bounded box, in which both states are.
        steps: by which the states differ at most, input by input.
        differences: of outputs, a row each.
    """
    low, high = _pre_activations(network, domain)
    n, step = network.n_hidden, np.array(steps, dtype=object)
    undecided = [i for i in range(n) if low[i] <= 0 < high[i]]
    if len(undecided) > _MOST:
        least, most = _slopes(network, low[:n] > 0, high[:n] > 0)
        bounds = _interval_product(differences.astype(object), least, most)
        return list(np.maximum(abs(bounds[0]), abs(bounds[1])) @ step)
    units, outcomes = ExactUnits(network), [bool(value > 0) for value in low[:n]]
    largest = np.array([Fraction(0)] * len(differences), dtype=object)
    for sides in product((False, True), repeat=len(undecided)):
        for i, side in zip(undecided, sides, strict=True):
            outcomes[i] = side
        slopes = differences.astype(object) @ units.forms(outcomes)[n:, :-1]
        largest = np.maximum(largest, abs(slopes) @ step)
    return [change / 2**units.power for change in largest]


def _fractions(values: NDArray[Any]) -> Fractions:
    exact = np.empty(values.shape, dtype=object)
    exact.ravel()[:] = [Fraction(value) for value in values.ravel().tolist()]
    return exact


def _interval_product(W: Fractions, low: Fractions, high: Fractions) -> tuple[Fractions, Fractions]:
    """Return the bounds of W @ X for X between low and high."""
    above, below = np.maximum(W, 0), np.minimum(W, 0)
    return above @ low + below @ high, above @ high + below @ low


def _pre_activations(network: ReluNetwork, domain: Domain) -> tuple[Fractions, Fractions]:
    """Return the bounds of all units over a box, (n + o,)."""
    units, slope = network.unit_form(), Fraction(network.negative_slope)
    links, inputs, offsets = (_fractions(part) for part in (units.links, units.inputs, units.offsets))
    own = _interval_product(inputs, _fractions(domain.low), _fractions(domain.high))
    low, high = (each + offsets for each in own)
    for start, stop in pairwise((*units.layer_starts, len(inputs))):
        active = [np.maximum(each[:start], slope * each[:start]) for each in (low, high)]
        of_links = _interval_product(links[start:stop, :start], *active)
        low[start:stop] += of_links[0]
        high[start:stop] += of_links[1]
    return low, high


def _slopes(network: ReluNetwork, always: NDArray[Any], ever: NDArray[Any]) -> tuple[Fractions, Fractions]:
    """Return the bounds of the outputs' slopes (o, d), of neurons that are always, or ever, above 0."""
    units, n = network.unit_form(), network.n_hidden
    slope = Fraction(network.negative_slope)
    links, inputs = _fractions(units.links), _fractions(units.inputs)
    least, most = (np.array([Fraction(1) if each else slope for each in side])[:, None] for side in (always, ever))
    low, high = inputs.copy(), inputs.copy()
    for start, stop in pairwise((*units.layer_starts, len(inputs))):
        active_low = np.minimum(low[:start] * least[:start], low[:start] * most[:start])
        active_high = np.maximum(high[:start] * least[:start], high[:start] * most[:start])
        of_links = _interval_product(links[start:stop, :start], active_low, active_high)
        low[start:stop] += of_links[0]
        high[start:stop] += of_links[1]
    return low[n:], high[n:]
