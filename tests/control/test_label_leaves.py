import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import otr
from otr.control import argmax_leaves
from tests.core.strategies import boundary_states, make_network


def tree_of(M, c):
    return otr.ObliqueTree([], [], np.zeros((0, np.shape(M)[1])), [], [M], [c])


@given(
    seed=st.integers(0, 2**32 - 1),
    widths=st.sampled_from([(), (1,), (2, 1), (3,)]),
    n_inputs=st.integers(1, 4),
    n_outputs=st.integers(1, 4),
    exact=st.booleans(),
)
def test_labels_are_the_argmax_of_the_leaf_outputs_everywhere(seed, widths, n_inputs, n_outputs, exact):
    rng = np.random.default_rng(seed)
    network = make_network(rng, widths, n_inputs=n_inputs, n_outputs=n_outputs, exact=exact)
    tree = otr.map_network(network)
    labelled = argmax_leaves(tree)
    assert labelled.head == otr.Argmax()
    if exact:  # small integers: no sum is rounded, ties are ties
        X = rng.integers(-3, 4, (200, n_inputs)).astype(float)
        np.testing.assert_array_equal(labelled.predict(X), tree.forward(X).argmax(axis=1))
    else:
        X = rng.normal(size=(200, n_inputs)) * 3
        outputs = np.sort(tree.forward(X), axis=1)
        clear = outputs[:, -1] - outputs[:, -2] > 1e-9 if n_outputs > 1 else slice(None)
        np.testing.assert_array_equal(labelled.predict(X)[clear], tree.forward(X).argmax(axis=1)[clear])
        X = np.concatenate((X, boundary_states(network, X[:50], rng)))
    np.testing.assert_allclose(labelled.forward(X), tree.forward(X), rtol=1e-9, atol=1e-9)
    assert labelled.n_leaves <= tree.n_leaves * 2 ** (n_outputs - 1)


def test_on_a_line_only_reachable_branches_are_left():
    """The upper envelope of -x, 0, x is -x then x; with 0 raised by 1 it has three pieces."""
    M = [[-1.0], [0.0], [1.0]]
    for offset, pieces in ((-1.0, [0, 2]), (1.0, [0, 1, 2])):
        labelled = argmax_leaves(tree_of(M, [0.0, offset, 0.0]))
        X = np.linspace(-3, 3, 601)[:, None] + 1e-7
        assert set(labelled.predict(X)) == set(pieces) and len(set(labelled.apply(X))) == labelled.n_leaves
    assert argmax_leaves(tree_of([[1.0]], [0.0])).predict([[5.0], [-5.0]]).tolist() == [0, 0]
    ties = otr.ObliqueTree([~0], [~1], [[1.0, 0.0]], [0.0], np.zeros((2, 3, 2)), [[1.0, 3.0, 3.0], [2.0, 2.0, 1.0]])
    labelled = argmax_leaves(ties)  # constant leaves need no tests
    assert (labelled.labels.tolist(), labelled.n_nodes) == ([1, 0], 1)


def test_a_test_above_decides_a_parallel_one_below():
    """Left of x <= 0 the output 2 x is below 0, right of it above: no test but the first is needed."""
    maps = np.tile([[0.0, 0.0], [2.0, 0.0]], (2, 1, 1)), np.zeros((2, 2))
    # With the opposite normal x = 0 belongs to the side of x >= 0, where 2 x > 0 is not settled there.
    for sign, n_nodes in ((1.0, 1), (-1.0, 2)):
        labelled = argmax_leaves(otr.ObliqueTree([~0], [~1], [[sign, 0.0]], [0.0], *maps))
        assert labelled.predict([[-1.0, 5.0], [1.0, -5.0], [0.0, 0.0]]).tolist() == [0, 1, 0]
        assert labelled.n_nodes == n_nodes
    apart = otr.ObliqueTree([~0], [~1], [[1.0, 0.0]], [1.0], *maps)
    assert argmax_leaves(apart).n_nodes == 2  # between -1 and 0 the label is still 0
