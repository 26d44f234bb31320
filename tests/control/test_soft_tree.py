import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.control.label_leaves import argmax_leaves
from otr.control.soft_trees.soft_tree import SoftTree

torch.set_num_threads(1)


def soft_tree(seed: int, depth: int, affine_leaves: bool, n_outputs: int = 3, n_inputs: int = 2) -> SoftTree:
    """A tree with leaves of unit size, in float64."""
    generator = torch.Generator().manual_seed(seed)
    tree = SoftTree(n_inputs, n_outputs, depth, affine_leaves=affine_leaves, generator=generator).double()
    torch.nn.init.normal_(tree.leaves, generator=generator)
    return tree


def clear_states(tree: otr.ObliqueTree, n: int, seed: int = 0, margin: float = 1e-2) -> np.ndarray:
    """States that lie at least `margin` away from zero in every test."""
    X = np.random.default_rng(seed).normal(size=(4 * n, tree.n_inputs)) * 2
    return X[(np.abs(X @ tree.P.T + tree.v) > margin).all(axis=1)][:n]


def naive_value(tree: SoftTree, x: np.ndarray, node: int = 0) -> np.ndarray:
    n_tests = len(tree.tests)
    x1 = np.append(x, 1.0)
    if node >= n_tests:
        leaf = tree.leaves.detach().numpy()[node - n_tests]
        return leaf @ x1 if tree.affine_leaves else leaf
    left = 1 / (1 + np.exp(float(tree.beta) * tree.tests.detach().numpy()[node] @ x1))
    return left * naive_value(tree, x, 2 * node + 1) + (1 - left) * naive_value(tree, x, 2 * node + 2)


@pytest.mark.parametrize("affine", [False, True])
@pytest.mark.parametrize("depth", [0, 1, 3])
def test_derivatives_of_the_tree(depth, affine):
    tree = soft_tree(5, depth, affine)
    tree.set_beta(2.0)
    X = torch.randn(3, 2, dtype=torch.float64, requires_grad=True)

    def outputs(tests: torch.Tensor, leaves: torch.Tensor, X: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(tree, {"tests": tests, "leaves": leaves}, (X,))

    arguments = (tree.tests, tree.leaves, X)
    assert torch.autograd.gradcheck(outputs, arguments)
    assert torch.autograd.gradgradcheck(outputs, arguments)
    assert torch.autograd.gradgradcheck(lambda *a: outputs(*a, X.detach()), arguments[:2])


@given(seed=st.integers(0, 2**31), depth=st.integers(0, 5), affine=st.booleans(), beta=st.sampled_from([0.5, 1, 8]))
@settings(max_examples=30)
def test_the_output_is_the_mean_over_paths(seed, depth, affine, beta):
    tree = soft_tree(seed, depth, affine)
    tree.set_beta(beta)
    X = np.random.default_rng(seed).normal(size=(5, 2))
    expected = [naive_value(tree, x) for x in X]
    np.testing.assert_allclose(tree(torch.tensor(X)).detach().numpy(), expected, rtol=1e-6, atol=1e-9)


@given(seed=st.integers(0, 2**31), depth=st.integers(0, 5), affine=st.booleans())
@settings(max_examples=30)
def test_the_hard_tree_is_the_limit(seed, depth, affine):
    tree = soft_tree(seed, depth, affine)
    hard = tree.harden()
    assert (hard.depth, hard.n_leaves) == (depth, 2**depth)
    X = clear_states(hard, 50, seed)
    tree.set_beta(1e4)
    np.testing.assert_allclose(hard.forward(X), tree(torch.tensor(X)).detach().numpy(), atol=1e-9)


@pytest.mark.parametrize("affine", [False, True])
def test_labels_are_the_largest_logits(affine):
    tree = soft_tree(1, 3, affine)
    hard = tree.harden(otr.Argmax())
    X = np.random.default_rng(0).normal(size=(300, 2)) * 2
    assert hard.labels is not None
    np.testing.assert_array_equal(hard.predict(X), tree.harden().forward(X).argmax(axis=1))
    assert hard.depth == (5 if affine else 3)
    leaf, clip = soft_tree(3, 0, True, n_outputs=4).harden(), otr.ClipBox(-0.1, 0.1)
    np.testing.assert_array_equal(argmax_leaves(leaf).predict(X), leaf.forward(X).argmax(axis=1))
    np.testing.assert_allclose(tree.harden(clip).predict(X), np.clip(tree.harden().forward(X), -0.1, 0.1))


def test_axis_aligned_tests_keep_the_largest_weight():
    tree = soft_tree(0, 2, False)
    with torch.no_grad():
        tree.tests.copy_(torch.tensor([[0.5, -2.0, 3.0], [4.0, 1.0, -2.0], [0.0, 0.0, 1.0]]))
    hard = tree.harden(axis_aligned=True)
    np.testing.assert_array_equal(hard.P, [[0, -1], [1, 0], [0, 0]])
    np.testing.assert_array_equal(hard.v, [1.5, -0.5, 1.0])
    np.testing.assert_array_equal(hard.c, tree.harden().c)
