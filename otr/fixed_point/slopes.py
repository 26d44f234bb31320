"""By how much a network's outputs can change when its inputs do: bounds over a box, in rational arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import IntArray
from otr.core.domain import Domain
from otr.core.network import ReluNetwork

Fractions = NDArray[Any]  # of Fraction
fractions = np.vectorize(Fraction, otypes=[object])


def largest_changes(
    network: ReluNetwork, domain: Domain, steps: Sequence[Fraction], differences: IntArray
) -> list[Fraction]:
    """Return bounds on the changes of differences of outputs, (m, o) @ y, between two states of a bounded box.

    On the way from one to the other the slopes are those of activation patterns: pre-activations and slopes are bounded
    unit by unit, by intervals, and a neuron that is on one side of 0 in all of the box has one slope.

    Args:
        network, domain: the network and the box, in which both states are.
        steps: by which the states differ at most, input by input.
        differences: of outputs, a row each.
    """
    units, slope = network.unit_form(), Fraction(network.negative_slope)
    links, inputs = fractions(units.links), fractions(units.inputs)
    low, high = interval_product(inputs, fractions(domain.low), fractions(domain.high))
    low, high = low + fractions(units.offsets), high + fractions(units.offsets)
    least, most = inputs.copy(), inputs.copy()  # slopes, (n_units, d)
    for start, stop in pairwise((*units.layer_starts, len(inputs))):
        W, rows = links[start:stop, :start], slice(start, stop)
        if not start:
            continue
        active = [np.maximum(each[:start], slope * each[:start]) for each in (low, high)]
        off, on = (np.array([Fraction(1) if z > 0 else slope for z in each[:start]])[:, None] for each in (low, high))
        passed = np.minimum(least[:start] * off, least[:start] * on), np.maximum(most[:start] * off, most[:start] * on)
        for ends, added in (((low, high), active), ((least, most), passed)):
            for end, change in zip(ends, interval_product(W, *added), strict=True):
                end[rows] += change
    n = network.n_hidden
    bounds = interval_product(differences.astype(object), least[n:], most[n:])
    return list(np.maximum(abs(bounds[0]), abs(bounds[1])) @ np.array(steps, dtype=object))


def interval_product(W: Fractions, low: Fractions, high: Fractions) -> tuple[Fractions, Fractions]:
    """Return the bounds of W @ X for X between low and high."""
    above, below = np.maximum(W, 0), np.minimum(W, 0)
    return above @ low + below @ high, above @ high + below @ low
