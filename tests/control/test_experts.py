"""Linear experts: the tree that they are, the straight-through derivative, and how evenly they are used."""

import copy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.control import ExpertsFit, LinearExperts
from otr.control.search.policy_numbers import policy_numbers
from otr.control.soft_trees.policy_module import policy_module

torch.set_num_threads(1)


def experts(seed: int, n_experts: int, n_inputs: int = 3, n_outputs: int = 2) -> LinearExperts:
    generator = torch.Generator().manual_seed(seed)
    module = LinearExperts(n_inputs, n_outputs, n_experts, generator=generator).double()
    torch.nn.init.normal_(module.experts, generator=generator)
    torch.nn.init.normal_(module.router, generator=generator)
    return module


@settings(max_examples=30)
@given(seed=st.integers(0, 2**16), n_experts=st.integers(1, 7))
def test_the_tree_does_what_the_experts_do(seed: int, n_experts: int) -> None:
    module = experts(seed, n_experts)
    tree = module.harden(otr.TanhBox([-1, -2], [1, 2]))
    tree.check()
    X = np.random.default_rng(seed).normal(size=(400, 3)) * 2
    scores = X @ module.router.detach().numpy()[:, :-1].T + module.router.detach().numpy()[:, -1]
    clear = np.diff(np.sort(scores, axis=1)[:, -2:], axis=1).ravel() > 1e-9 if n_experts > 1 else np.full(400, True)
    ours = module(torch.as_tensor(X[clear])).detach().numpy()
    np.testing.assert_allclose(tree.forward(X[clear]), ours, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(tree.predict(X[clear]), np.tanh(ours) * [1, 2], rtol=1e-12, atol=1e-12)
    assert tree.depth <= n_experts - 1
    tests = np.column_stack((tree.P, tree.v))
    assert len(np.unique(tests.round(9), axis=0)) <= n_experts * (n_experts - 1) // 2


def test_of_equal_scores_the_first_acts_and_what_has_acted_can_be_copied() -> None:
    module = experts(0, 3)
    with torch.no_grad():
        module.router.zero_()
    x = np.array([[0.5, -1.0, 2.0]])
    first = module.experts.detach().numpy()[0]
    acts = module(torch.as_tensor(x))
    np.testing.assert_allclose(acts.detach().numpy()[0], first[:, :-1] @ x[0] + first[:, -1])
    np.testing.assert_allclose(module.harden().predict(x)[0], first[:, :-1] @ x[0] + first[:, -1])
    torch.testing.assert_close(copy.deepcopy(module)(torch.as_tensor(x)), acts)


def test_the_derivative_is_that_of_the_mean_of_experts() -> None:
    """By the router as if softmax weighed the experts; by the experts as the one that acts."""
    module = experts(1, 4)
    X = torch.randn(5, 3, dtype=torch.float64)
    at = torch.randn(5, 2, dtype=torch.float64)
    (by_router, by_experts) = torch.autograd.grad((module(X) * at).sum(), [module.router, module.experts])
    X1 = torch.cat((X, torch.ones(5, 1, dtype=torch.float64)), dim=1)

    def soft(router: torch.Tensor) -> torch.Tensor:
        answers = torch.einsum("koj,nj->nko", module.experts.detach(), X1)
        return (torch.einsum("nk,nko->no", torch.softmax(X1 @ router.t(), dim=1), answers) * at).sum()

    router = module.router.detach().clone().requires_grad_()
    (expected,) = torch.autograd.grad(soft(router), router)
    torch.testing.assert_close(by_router, expected)
    chosen = (X1 @ module.router.t()).argmax(dim=1)
    for k in range(4):
        mine = chosen == k
        torch.testing.assert_close(by_experts[k], torch.einsum("no,nj->oj", at[mine], X1[mine]))


def test_balance_is_one_where_all_are_used_alike_and_k_where_one_is() -> None:
    module = experts(2, 4, n_inputs=4)
    with torch.no_grad():
        module.router.copy_(torch.eye(4, 5) * 50)
    module(torch.eye(4, dtype=torch.float64))
    assert module.balance.item() == pytest.approx(1.0, abs=1e-6)
    module(torch.eye(4, dtype=torch.float64)[[0, 0, 0]])
    assert module.balance.item() == pytest.approx(4.0, abs=1e-6)


def test_a_polish_moves_experts_and_tests_as_one_each() -> None:
    """By search and by gradient: of 8 leaves and 7 nodes there stay 4 experts and 6 tests, with a number each."""
    tree = experts(5, 4).harden(otr.TanhBox([-1, -1], [1, 1]))
    X = np.random.default_rng(0).normal(1, 2, size=(300, 3))
    assert [len(np.unique(forms, axis=0)) for forms in (tree.leaf_forms, tree.test_forms)] == [4, 6]
    numbers = policy_numbers(tree, X, tied=True)
    assert numbers.start.size == (4 * 2 + 6) * 4
    assert policy_numbers(tree, X).start.size == (8 * 2 + 7) * 4
    searched = numbers.policy(numbers.start + np.random.default_rng(1).normal(size=numbers.start.size))

    torch.set_default_dtype(torch.float64)
    try:
        module = policy_module(tree, X, tied=True)
        np.testing.assert_allclose(module(torch.as_tensor(X)).detach(), tree.forward(X), atol=1e-9)
        optimiser = torch.optim.Adam(module.parameters(), lr=0.05)
        for _ in range(20):
            optimiser.zero_grad()
            (module(torch.as_tensor(X)) - torch.as_tensor(X[:, :2])).square().mean().backward()
            optimiser.step()
        learnt = module.policy()
        np.testing.assert_allclose(module(torch.as_tensor(X)).detach(), learnt.forward(X), atol=1e-9)
    finally:
        torch.set_default_dtype(torch.float32)
    for moved in (searched, learnt):
        assert isinstance(moved, otr.ObliqueTree)
        assert (moved.leaf_forms != tree.leaf_forms).any() and (moved.test_forms != tree.test_forms).any()
        for kept, now in ((tree.leaf_forms, moved.leaf_forms), (tree.test_forms, moved.test_forms)):
            np.testing.assert_array_equal(same(kept), same(now))


def same(forms: np.ndarray) -> np.ndarray:
    flat = forms.reshape(len(forms), -1)
    return np.asarray((flat[:, None] == flat[None]).all(axis=2))


def test_other_units() -> None:
    module, other = experts(3, 3), experts(3, 3)
    shift, scale = np.array([1.0, -2.0, 0.5]), np.array([2.0, 0.1, 3.0])
    other.substitute(shift, scale)
    U = np.random.default_rng(0).normal(size=(50, 3))
    ours = module(torch.as_tensor(shift + scale * U)).detach()
    torch.testing.assert_close(other(torch.as_tensor(U)).detach(), ours, rtol=1e-9, atol=1e-9)


def test_experts_are_fitted_to_an_oracle_s_actions_within_their_box() -> None:
    """Of three experts that they are meant to find again, with inputs of many units, one constant."""
    box = otr.ClipBox([-2.0, -1.0], [2.0, 3.0])
    oracle = experts(6, 3).harden(box)
    unit = np.random.default_rng(0).normal(size=(3000, 3))
    scale, mean = np.array([1.0, 50.0, 0.01]), np.array([0.0, 200.0, -1.0])
    X, answers = np.column_stack((unit * scale + mean, np.full(3000, 7.0))), oracle.predict(unit)
    assert 0.1 < np.mean((answers == [-2, -1]) | (answers == [2, 3])) < 0.7

    def fit(n_experts: int, n_updates: int, head: otr.Head = box) -> otr.ObliqueTree:
        return ExpertsFit(head, n_experts, n_updates=n_updates)(X, answers, None, np.random.default_rng(1))

    tree, linear = fit(3, 1500), fit(1, 1500)
    errors = [np.mean((each.predict(X) - answers) ** 2) for each in (tree, linear)]
    assert errors[0] < 0.2 * errors[1] and tree.n_leaves <= 4 and tree.head == box
    np.testing.assert_array_equal(fit(3, 20).leaf_forms, fit(3, 20).leaf_forms)
    with pytest.raises(ValueError, match="expected a ClipBox with finite limits"):
        fit(3, 20, otr.Argmax())
