"""Scales by sensitivity: the analytic one where there is one, their cap, and the size that loses little."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.control.search.policy_numbers import policy_numbers
from otr.control.search.sensitivity import sensitivity_scale

SEEDS = st.integers(0, 2**32 - 1)
STATES = np.random.default_rng(0).normal(size=(300, 2)) * [1.0, 5.0] + [0.0, 3.0]


def capped(reactions: np.ndarray) -> np.ndarray:
    scale = 1 / reactions / np.sqrt(len(reactions))
    return np.minimum(scale, 3 * np.median(scale))


@given(SEEDS, st.integers(1, 4), st.integers(1, 3), st.booleans())
@settings(max_examples=30)
def test_of_a_linear_policy_it_is_the_analytic_one(seed: int, d: int, o: int, clipped: bool) -> None:
    """d(action of row k) / d theta is r_k s and, of the offset, r_k: s standardised, rms 1, in half ranges."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(200, d)) * rng.uniform(0.1, 10.0, d) + rng.normal(size=d)
    W, b = rng.normal(size=(o, d)) * 10.0 ** -np.arange(o)[:, None], rng.normal(size=o) * 10.0 ** -np.arange(o)
    half = np.full(o, 1e6) if clipped else np.ones(o)
    policy = otr.ReluNetwork([W], [b], head=otr.ClipBox(-half, half) if clipped else otr.Identity())
    sizes = np.hypot(np.linalg.norm(W * X.std(axis=0), axis=1), W @ X.mean(axis=0) + b)
    expected = capped(np.repeat(sizes / half, d + 1))
    for each in (policy, otr.map_network(policy)):
        np.testing.assert_allclose(sensitivity_scale(policy_numbers(each, X), X), expected, rtol=1e-6)


def test_a_number_that_changes_nothing_has_the_cap() -> None:
    """The second neuron is off in all states, and its share of the outputs with it; of a cut-off head all are."""
    network = otr.ReluNetwork([[[1.0, 0.1], [0.1, 0.1]], [[1.0, 1.0]]], [[0.5, -1e3], [0.2]])
    scale = sensitivity_scale(policy_numbers(network, STATES), STATES)
    on, off = scale[[0, 1, 2, 6, 8]], scale[[3, 4, 5, 7]]
    assert (off == 3 * np.median(on)).all() and (on <= off[0]).all()
    cut = otr.ReluNetwork([[[1.0, 1.0]]], [[1e3]], head=otr.ClipBox([-1.0], [1.0]))
    assert sensitivity_scale(policy_numbers(cut, STATES), STATES).tolist() == [1.0, 1.0, 1.0]


def test_a_test_counts_by_the_states_that_change_sides() -> None:
    """One test between leaves that are alike moves further than one between leaves that differ."""

    def scale_of_the_test(step: float) -> float:
        tree = otr.ObliqueTree([-1], [-2], [[1.0, 0.0]], [-0.1], np.zeros((2, 1, 2)), [[1.0], [1.0 + step]])
        return sensitivity_scale(policy_numbers(tree, STATES), STATES)[0]

    assert scale_of_the_test(1.0) > scale_of_the_test(10.0) > 0


@pytest.mark.parametrize("tolerance", [1.0, 0.01])
def test_the_size_is_the_largest_that_loses_little(tolerance: float) -> None:
    """The return is 10 less the squared distance in units of `tolerance`, and what the start is worth."""
    policy, reports, tried = otr.ReluNetwork([[[0.6, 0.1]]], [[-0.5]]), [], []

    def evaluate(policies, seeds):
        lost = [np.sum((each.weights[0] - policy.weights[0]) ** 2) / tolerance**2 for each in policies]
        if len(policies) == 16:
            tried.append(np.median(lost))
        return 10.0 - np.array(lost)[:, None] + np.sin(seeds)

    search = otr.SearchSettings(n_directions=8, n_top=4, step_size=0.1, noise=0.5)
    arguments = {"settings": search, "n_iterations": 1, "n_candidates": 1, "n_selection_episodes": 2}
    arguments |= {"states": STATES, "scale": "sensitivity", "report": reports.append}
    otr.polish(policy, evaluate, **arguments)
    *larger, last, _ = tried  # the last of the tried sets is the first iteration's
    size = reports[-1].size
    assert size == 8.0 / 2 ** len(larger) and (tolerance == 1.0) == (size > 0.25)
    assert last < 0.6 and all(lost > 0.4 for lost in larger) and len(larger) > 0
    np.testing.assert_allclose(larger, [last * 4.0**k for k in range(len(larger), 0, -1)], rtol=1e-6)


def test_labels_and_other_scales_are_refused() -> None:
    network = otr.ReluNetwork([np.eye(2)], [np.ones(2)], head=otr.Argmax())
    labelled = otr.ObliqueTree([-1], [-2], [[1.0, 0.0]], [0.3], np.zeros((2, 1, 2)), np.ones((2, 1)), labels=[0, 1])
    for policy in (network, labelled):
        with pytest.raises(ValueError, match="labels, which have no derivative"):
            otr.polish(policy, lambda policies, seeds: 0.0 * seeds, states=STATES, scale="sensitivity")
    with pytest.raises(ValueError, match="scale=rows: use one of uniform, sensitivity"):
        otr.polish(network, lambda policies, seeds: 0.0 * seeds, states=STATES, scale="rows")
