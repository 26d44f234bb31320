"""Policies as modules: the policy's answers forwards, the soft surrogate's gradient backwards, the same structure."""

import numpy as np
import pytest
import torch

import otr
from otr.control.soft_trees.policy_module import NetworkModule, TreeModule, policy_module
from tests.core.strategies import make_network

torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def in_float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def crooked_tree(head=None):
    """Return a tree of five tests and six leaves, no two of which lie at the same depth on both sides; some zeros."""
    generator = np.random.default_rng(3)
    P, M = generator.normal(size=(5, 3)), generator.normal(size=(6, 2, 3))
    P[1, 0] = M[2] = M[4, 1, 1] = 0.0
    v, c = generator.normal(size=5) / 2, generator.normal(size=(6, 2))
    v[2] = c[0, 0] = 0.0
    return otr.ObliqueTree([1, 2, ~0, ~2, ~4], [4, 3, ~1, ~3, ~5], P, v, M, c, head=head)


def states(n=400):
    return np.random.default_rng(0).normal([1, 0, -1], [2, 1, 3], (n, 3))


def outputs(tree, X):
    leaves = tree.apply(X)
    return np.einsum("nod,nd->no", tree.M[leaves], X) + tree.c[leaves]


def test_a_tree_answers_as_it_does():
    tree, X = crooked_tree(), states()
    module = TreeModule(tree, X)
    np.testing.assert_allclose(module(torch.from_numpy(X)).detach(), outputs(tree, X), atol=1e-9)
    with torch.no_grad():
        np.testing.assert_allclose(module(torch.from_numpy(X)), outputs(tree, X), atol=1e-9)
    assert len(set(tree.apply(X))) == 6
    leaf = otr.ObliqueTree([], [], np.zeros((0, 3)), [], [[[1.0, 0.0, 2.0]]], [[0.5]])
    np.testing.assert_allclose(policy_module(leaf, X)(torch.from_numpy(X)).detach(), outputs(leaf, X), atol=1e-9)
    with pytest.raises(ValueError, match="answers with labels"):
        policy_module(crooked_tree(otr.Argmax()), X)
    torch.set_default_dtype(torch.float32)
    single = TreeModule(tree, X)(torch.from_numpy(X).float()).detach()
    assert (np.abs(single.numpy() - outputs(tree, X)).max(axis=1) < 1e-5).mean() > 0.99  # but at tests that are ties


@pytest.mark.parametrize("dense", [False, "input", "all"])
@pytest.mark.parametrize("slope", [0.0, 0.1])
def test_a_network_answers_as_it_does(dense, slope):
    X = states()
    network = make_network(np.random.default_rng(1), (4, 5), n_outputs=2, dense=dense, negative_slope=slope)
    module = NetworkModule(network, X)
    np.testing.assert_allclose(module(torch.from_numpy(X)).detach(), network.forward(X), atol=1e-9)
    for ours, theirs in zip(module.policy().weights, network.weights, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_tests_have_the_gradient_of_the_soft_tree_and_leaves_that_of_the_hard_one():
    tree, X = crooked_tree(), torch.from_numpy(states(60))
    module = TreeModule(tree, X.numpy(), hardness=1.5)
    wanted = torch.from_numpy(np.random.default_rng(2).normal(size=(60, 2)))
    (module(X) * wanted).sum().backward()
    tests, leaves = (rows.numbers for rows in module.rows)
    for parameter, function in ((tests, module.soft), (leaves, module.forward)):
        found = torch.zeros_like(parameter)
        for i in np.ndindex(*parameter.shape):
            sides = []
            for step in (1e-6, -1e-6):
                with torch.no_grad():
                    parameter[i] += step
                    sides.append((function(X) * wanted).sum())
                    parameter[i] -= step
            found[i] = (sides[0] - sides[1]) / 2e-6
        assert found.abs().max() > 0.1
        torch.testing.assert_close(parameter.grad, found, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("free", [False, True])
def test_what_is_zero_stays_and_the_structure_does(free):
    tree, X = crooked_tree(otr.ClipBox([-1, -1], [1, 1])), states()
    module = policy_module(tree, X, free=free)
    assert module.n_numbers == (20 + 48 if free else 20 + 48 - 10)
    optimiser = torch.optim.Adam(module.parameters(), 0.05)
    for _ in range(20):
        optimiser.zero_grad()
        (module(torch.from_numpy(X)) - 1).square().mean().backward()
        optimiser.step()
    learnt = module.policy()
    for name in ("children_left", "children_right"):
        np.testing.assert_array_equal(getattr(learnt, name), getattr(tree, name))
    assert learnt.head == tree.head
    pairs = [(learnt.test_forms, tree.test_forms), (learnt.leaf_forms, tree.leaf_forms)]
    for ours, theirs in pairs:
        assert free or (ours[theirs == 0] == 0).all()
        assert (np.abs(ours - theirs)[theirs != 0] > 0).mean() > 0.9
    np.testing.assert_allclose(module(torch.from_numpy(X)).detach(), outputs(learnt, X), atol=1e-9)
    assert ((outputs(learnt, X) - 1) ** 2).mean() < ((outputs(tree, X) - 1) ** 2).mean()
