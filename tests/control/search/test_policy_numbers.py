"""Policies as vectors: what moves, in which units, and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import otr
from otr.control import pid_network
from otr.control.search.policy_numbers import AffineRows, policy_numbers
from tests.core.strategies import Case, cases

CENTRE, SPREAD = np.array([2.0, -1.0, 0.5, 10.0]), np.array([0.5, 3.0, 1.0, 0.01])
SEEDS = st.integers(0, 2**32 - 1)


def visited(n_inputs: int, n: int = 200) -> np.ndarray:
    states = np.random.default_rng(1).normal(size=(n, n_inputs))
    return CENTRE[:n_inputs] + SPREAD[:n_inputs] * states


def sparse(network: otr.ReluNetwork, seed: int, share: float) -> otr.ReluNetwork:
    rng = np.random.default_rng(seed)

    def thinned(arrays):
        return [np.where(rng.random(array.shape) < share, 0.0, array) for array in arrays]

    return network.replace(weights=thinned(network.weights), biases=thinned(network.biases))


def numbers_of(policy):
    if isinstance(policy, otr.ReluNetwork):
        return [*policy.weights, *policy.biases]
    return [policy.P, policy.v, policy.M, policy.c]


@given(cases(max_layers=3), SEEDS, st.sampled_from((0.0, 0.4)), st.booleans(), st.booleans())
def test_back_and_forth_is_exact_up_to_rounding(case: Case, seed: int, share: float, free: bool, as_tree: bool) -> None:
    network = sparse(case.network, seed, share)
    policy = otr.map_network(network) if as_tree else network
    numbers = policy_numbers(policy, visited(network.n_inputs), free=free)
    assert numbers.policy(numbers.start) is policy
    # As it would be without that short cut.
    again = numbers._rebuilt([rows.forms(rows.start) for rows in numbers.rows])
    for ours, theirs in zip(numbers_of(again), numbers_of(policy), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(theirs).max(initial=0.0)))
    assert type(again) is type(policy) and again.head == policy.head
    if as_tree:
        np.testing.assert_array_equal(again.children_left, policy.children_left)
        np.testing.assert_array_equal(again.labels, policy.labels)


@given(cases(max_layers=2), SEEDS, st.booleans())
def test_zero_stays_zero_and_all_else_moves_but_where_all_is_free(case: Case, seed: int, as_tree: bool) -> None:
    network, generator = sparse(case.network, seed, 0.5), np.random.default_rng(seed)
    policy = otr.map_network(network) if as_tree else network
    numbers = policy_numbers(policy, visited(network.n_inputs))
    moved = numbers.policy(numbers.start + generator.normal(size=numbers.start.shape))
    leaves_stay = as_tree and policy.labels is not None
    for i, (ours, theirs) in enumerate(zip(numbers_of(moved), numbers_of(policy), strict=True)):
        if leaves_stay and i >= 2:
            np.testing.assert_array_equal(ours, theirs)
        else:
            np.testing.assert_array_equal(ours != 0, theirs != 0)
            assert (ours != theirs)[theirs != 0].all()
    numbers = policy_numbers(network, visited(network.n_inputs), free=True)
    assert numbers.start.size == sum(array.size for array in numbers_of(network))
    moved = numbers.policy(numbers.start + generator.normal(size=numbers.start.shape))
    assert all((ours != theirs).all() for ours, theirs in zip(numbers_of(moved), numbers_of(network), strict=True))


@given(cases(max_layers=3), SEEDS, st.booleans())
def test_the_vector_does_not_depend_on_units_of_states_nor_of_neurons(case: Case, seed: int, as_tree: bool) -> None:
    """The same policy of states in other units, and behind neurons in other units, is the same vector."""
    rng = np.random.default_rng(seed)
    network, X = case.network, visited(case.network.n_inputs)
    scale, shift = rng.uniform(0.1, 10.0, network.n_inputs), rng.normal(size=network.n_inputs)
    network = network.replace(biases=[b + rng.normal(size=b.shape) for b in network.biases])  # centred rows
    if as_tree:
        policy = otr.map_network(network)
        other = policy.compose(np.diag(1 / scale), -shift / scale)
    else:
        policy, other = network, network.fold_input_normalisation(shift, scale)
    expected = policy_numbers(policy, X).start
    np.testing.assert_allclose(policy_numbers(other, X * scale + shift).start, expected, atol=1e-6)
    if network.hidden_widths and network.dense is False and not as_tree:
        factor = rng.uniform(0.1, 10.0, network.hidden_widths[0])
        weights, biases = list(network.weights), list(network.biases)
        weights[0], biases[0] = weights[0] * factor[:, None], biases[0] * factor
        weights[1] = weights[1] / factor
        rescaled = network.replace(weights=weights, biases=biases)
        np.testing.assert_allclose(policy_numbers(rescaled, X).start, expected, atol=1e-9)


def test_the_numbers_of_a_row_worked_out_by_hand() -> None:
    """The test 3 x - 8 <= 0 of states 2 +- 0.5 is 1.5 s - 2, of size 2.5; without an offset 3 x is 3 sqrt(4.25) s."""
    means, deviations = np.array([2.0]), np.array([0.5])
    centred = AffineRows(np.array([[3.0, -8.0]]), means, deviations, free=False)
    np.testing.assert_allclose(centred.start, [1.5 / 2.5, -2.0 / 2.5])
    np.testing.assert_allclose(centred.forms(np.array([0.6, -0.4])), [[3.0, -1.0 - 6.0]])
    through_zero = AffineRows(np.array([[3.0, 0.0]]), means, deviations, free=False)
    assert through_zero.start.tolist() == [1.0]
    np.testing.assert_allclose(through_zero.sizes, 3 * np.sqrt(4.25))
    np.testing.assert_allclose(through_zero.forms(np.array([1.1])), [[3.3, 0.0]])


def test_units_where_there_is_nothing_to_measure() -> None:
    rows = AffineRows(
        np.array([[2.0, 0.1, 1.0], [0.0, 0.0, 0.0]]), np.array([0.3, 0.0]), np.array([1e-17, 0.0]), free=True
    )
    moved = rows.forms(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    # A constant component counts as 1; a row of zeros has the size of the other one, 2 s_0 + 0.1 s_1 + 1.6.
    np.testing.assert_allclose(rows.sizes, np.sqrt(4 + 0.01 + 1.6**2) * np.ones(2))
    np.testing.assert_allclose(moved[1], [0.0, 0.0, rows.sizes[0]])
    still = otr.ObliqueTree([], [], np.zeros((0, 2)), [], np.zeros((1, 1, 2)), [[0.0]], head=otr.ClipBox([-3.0], [3.0]))
    assert policy_numbers(still, np.ones((5, 2))).start.size == 0
    numbers = policy_numbers(still, np.ones((5, 2)), free=True)
    np.testing.assert_allclose(numbers.policy([0.0, 0.0, 0.5]).c, [[1.5]])


def test_the_terms_of_a_pid_policy_stay() -> None:
    rng = np.random.default_rng(0)
    gains = otr.ReluNetwork(
        [rng.normal(size=(2, 2)), rng.normal(size=(6, 2))], [rng.normal(size=2), rng.normal(size=6)]
    )
    network = pid_network(gains, np.array([-1.0]), np.array([1.0]))
    for policy in (network, otr.map_network(network)):
        numbers = policy_numbers(policy, visited(2, 50)[:, [0, 1] * 4] + rng.normal(size=(50, 8)), free=True)
        moved = numbers.policy(numbers.start + 1.0)
        outputs = moved.weights[-1] if policy is network else moved.M.reshape(-1, 12, 8)
        theirs = network.weights[-1] if policy is network else policy.M.reshape(-1, 12, 8)
        np.testing.assert_array_equal(outputs[..., :6, :], theirs[..., :6, :])
        assert (outputs[..., 6:, :] != theirs[..., 6:, :]).all()


def test_what_is_refused() -> None:
    network, X = otr.ReluNetwork([[[1.0, 2.0]]], [[0.0]]), np.ones((3, 2))
    for error, words, ask in (
        (TypeError, "PatternTree, expected an ObliqueTree or a", lambda: policy_numbers(otr.PatternTree(network), X)),
        (ValueError, "no states", lambda: policy_numbers(network, np.empty((0, 2)))),
        (ValueError, r"expected \(n, 2\)", lambda: policy_numbers(network, np.ones((3, 3)))),
        (ValueError, r"shape \(3,\), expected \(2,\)", lambda: policy_numbers(network, X).policy([1.0, 2.0, 3.0])),
    ):
        with pytest.raises(error, match=words):
            ask()
