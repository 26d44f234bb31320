"""Every call of the proofs keeps its limit of time, on cases that are far too large for it."""

import time
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

import otr
from otr.clock import check_time, time_limit
from otr.proof.certificate import Cell, Certificate, Sum
from tests.core.strategies import make_network

BOX = (-1.0, 1.0)
LIMIT_S, REST_S = 0.5, 1.0  # the rest is for a step that has begun
WIDE = make_network(np.random.default_rng(0), (40, 10), n_inputs=20)
NEVER = otr.Condition(np.zeros(30), np.ones(2), 1e6)
TWO = [otr.map_network(make_network(np.random.default_rng(n), (n,), n_inputs=30, n_outputs=2)) for n in (9, 3)]


@cache
def network(head: str = "identity") -> otr.ReluNetwork:
    return make_network(np.random.default_rng(0), (14,), n_inputs=30, n_outputs=2, head=head)


@cache
def full_tree(head: str = "identity") -> otr.ObliqueTree:
    return otr.map_network(network(head))


@cache
def constant_pair() -> tuple[Certificate, otr.ObliqueTree, otr.ReluNetwork]:
    """Return the certificate of a tree of 2**14 leaves that all hold what a network answers everywhere."""
    tree = full_tree().replace(M=np.zeros((2**14, 1, 30)), c=np.ones((2**14, 1)))
    one = otr.ReluNetwork([np.zeros((1, 30)), [[1.0]]], [[1.0], [0.0]])
    cells = tuple(Cell(leaf, "1", (), (Sum((), ()),)) for leaf in range(2**14))
    return Certificate(otr.Domain(np.full(30, -1.0), np.full(30, 1.0)), 0.0, 2**14, 0, cells), tree, one


CALLS: dict[str, Callable[[], object]] = {
    "minimal_tree": lambda: otr.minimal_tree(WIDE, BOX, max_seconds=LIMIT_S),
    "certify": lambda: otr.certify(full_tree(), network(), BOX, max_seconds=LIMIT_S),
    "verify": lambda: otr.verify(*constant_pair(), max_seconds=LIMIT_S),
    "output_range": lambda: otr.output_range(full_tree(), BOX, max_seconds=LIMIT_S),
    "reachable_labels": lambda: otr.reachable_labels(full_tree("argmax"), BOX, max_seconds=LIMIT_S),
    "find_violation": lambda: otr.find_violation(full_tree("tanh_box"), NEVER, BOX, max_seconds=LIMIT_S),
    "find_difference": lambda: otr.find_difference(*TWO, BOX, max_difference=1e6, max_seconds=LIMIT_S),
}


@pytest.mark.parametrize("call", CALLS)
def test_a_limit_of_time_is_kept(call: str) -> None:
    full_tree()
    constant_pair()
    began = time.process_time()  # other processes take their part of the limit
    with pytest.raises(otr.TimeLimitError, match=rf"^the limit of {LIMIT_S:g} s was met after .* s: .*; raise the lim"):
        CALLS[call]()
    assert time.process_time() - began < 1.1 * LIMIT_S + REST_S


def test_the_nearest_of_limits_within_each_other_counts() -> None:
    with time_limit(1000, lambda: "outer"):
        with pytest.raises(otr.TimeLimitError, match=r"0 s was met .*inner"), time_limit(0, lambda: "inner"):
            check_time()
        check_time()
    with (
        pytest.raises(otr.TimeLimitError, match="outer"),
        time_limit(0, lambda: "outer"),
        time_limit(1000, lambda: "inner"),
        time_limit(None, lambda: "none"),
    ):
        check_time()
    with pytest.raises(ValueError, match="max_seconds is -1, expected a number of at least 0, or None"):
        otr.minimal_tree(network(), BOX, max_seconds=-1)
    with pytest.raises(otr.TimeLimitError, match=r"0 of 16,384 leaves were checked"):
        otr.verify(*constant_pair(), max_seconds=0)
    with pytest.raises(otr.TreeTooLargeError, match=r"0 of 16,384 leaves had cells that are proved"):
        otr.certify(full_tree(), network(), BOX, max_seconds=0)
