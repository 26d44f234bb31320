import numpy as np
import pytest
import torch

import otr
from otr.control.soft_trees.cascading_tree import CascadingTree
from tests.control.test_soft_tree import clear_states

torch.set_num_threads(1)


def cascade(seed: int, feature_depth: int = 2, decision_depth: int = 3) -> CascadingTree:
    generator = torch.Generator().manual_seed(seed)
    tree = CascadingTree(
        5, 3, feature_depth=feature_depth, n_features=2, decision_depth=decision_depth, generator=generator
    ).double()
    torch.nn.init.normal_(tree.decisions.leaves, generator=generator)
    return tree


@pytest.mark.parametrize("axis_aligned", [False, True])
@pytest.mark.parametrize(("seed", "depths"), [(0, (2, 3)), (1, (2, 3)), (2, (0, 2)), (3, (2, 0)), (4, (0, 0))])
def test_one_tree_on_the_states_is_the_cascade(seed, depths, axis_aligned):
    tree = cascade(seed, *depths)
    features, decisions = (part.harden(axis_aligned=axis_aligned) for part in (tree.features, tree.decisions))
    X = np.random.default_rng(seed).normal(size=(500, 5)) * 3
    whole = tree.harden(axis_aligned=axis_aligned)
    np.testing.assert_allclose(whole.forward(X), decisions.forward(features.forward(X)), rtol=1e-9, atol=1e-9)
    assert (whole.n_inputs, whole.depth, whole.n_leaves) == (5, sum(depths), 2 ** sum(depths))
    labels = tree.harden(otr.Argmax(), axis_aligned=axis_aligned).predict(X)
    np.testing.assert_array_equal(labels, whole.forward(X).argmax(axis=1))


def test_parts_are_axis_aligned_and_limits_and_all_parameters_get_gradients():
    tree = cascade(0)
    whole = tree.harden(axis_aligned=True)
    assert (np.count_nonzero(whole.P[:3], axis=1) == 1).all()
    maps = tree.features.harden().M  # (4, 2, 5): a decision's test is plus or minus one feature of its leaf
    for P in whole.P[3:10]:
        assert min(np.abs(P - sign * row).max() for sign in (1, -1) for row in maps[0]) < 1e-12
    tree(torch.randn(9, 5, dtype=torch.float64)).square().sum().backward()
    assert all(parameter.grad.abs().max() > 0 for parameter in tree.parameters())
    whole = tree.harden()
    X = clear_states(whole, 50)
    assert len(X) == 50
    tree.set_beta(1e5)
    np.testing.assert_allclose(tree(torch.tensor(X)).detach().numpy(), whole.forward(X), atol=1e-9)
