"""Exactness at the size of the molecules: 1,513 rows, 2,048 inputs of which some fifty are ones."""

import numpy as np
import pytest

import otr
from otr.learners import LCNClassifier, OTRClassifier

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def molecules():
    rng = np.random.default_rng(0)
    frequent = rng.exponential(0.025, size=2048).clip(max=0.6)
    X = (rng.random((1513, 2048)) < frequent).astype(np.float64)
    y = (X @ rng.normal(size=2048) > 0).astype(int)
    return X, y


def test_lcn_of_depth_12_equals_its_tree(molecules):
    X, y = molecules
    model = LCNClassifier(12, drop_connect=0.75, random_state=1).fit(
        X[:1210], y[:1210], validation=(X[1210:], y[1210:])
    )
    assert model.tree_.n_leaves == 4096
    np.testing.assert_allclose(model.tree_.forward(X), model.network_.forward(X), rtol=0, atol=1e-9)


@pytest.mark.parametrize("dense", [False, "all"])
def test_otr_equals_its_tree_and_its_pruned_tree(molecules, dense):
    X, y = molecules
    model = OTRClassifier((8, 8), dense=dense, random_state=1)
    model.fit(X[:1210], y[:1210], validation=(X[1210:], y[1210:]))
    assert isinstance(model.tree_, otr.PatternTree)
    [pruned] = model.prune(X)
    np.testing.assert_allclose(pruned.forward(X), model.network_.forward(X), rtol=0, atol=1e-9)
    # The first layer's neurons alone make a tree that can be written out in full: 256 leaves.
    first = otr.ReluNetwork(model.network_.weights[:2], model.network_.biases[:2], dense=dense)
    np.testing.assert_allclose(otr.map_network(first).forward(X), first.forward(X), rtol=0, atol=1e-9)
