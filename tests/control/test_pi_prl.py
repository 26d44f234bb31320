import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.control.soft_trees.relaxed_program import RelaxedProgram
from tests.control.test_soft_tree import clear_states

torch.set_num_threads(1)


def relaxed(seed: int, depth: int = 3) -> RelaxedProgram:
    generator = torch.Generator().manual_seed(seed)
    program = RelaxedProgram(2, 3, depth, generator=generator).double()
    torch.nn.init.normal_(program.maps, generator=generator)
    torch.nn.init.normal_(program.architecture, generator=generator)
    return program


def naive_value(program: RelaxedProgram, x: np.ndarray, hole: int = 0) -> np.ndarray:
    x1 = np.append(x, 1.0)
    here = program.maps.detach().numpy()[hole] @ x1
    if hole >= len(program.tests):
        return here
    odds = np.exp(program.architecture.detach().numpy()[hole])
    if program.is_discrete:
        odds = np.array([1 - program.structure[hole], program.structure[hole]])
    left = 1 / (1 + np.exp(float(program.beta) * program.tests.detach().numpy()[hole] @ x1))
    below = left * naive_value(program, x, 2 * hole + 1) + (1 - left) * naive_value(program, x, 2 * hole + 2)
    return (odds[0] * here + odds[1] * below) / odds.sum()


@pytest.mark.parametrize("depth", [0, 1, 3])
def test_the_value_is_the_recursion(depth):
    check_value(relaxed(0, depth), 0)


def check_value(program: RelaxedProgram, seed: int) -> None:
    X = np.random.default_rng(seed).normal(size=(8, 2))
    expected = [naive_value(program, x) for x in X]
    np.testing.assert_allclose(program(torch.tensor(X)).detach().numpy(), expected, rtol=1e-6, atol=1e-9)


@given(seed=st.integers(0, 2**31), depth=st.integers(1, 4), beta=st.sampled_from([0.5, 1.0, 8.0]))
@settings(max_examples=30)
def test_a_chosen_program_has_the_value_of_the_recursion(seed, depth, beta):
    program = relaxed(seed, depth)
    program.set_beta(beta)
    program.discretise()
    check_value(program, seed)


@pytest.mark.parametrize("is_discrete", [False, True])
@pytest.mark.parametrize("depth", [0, 1, 3])
def test_derivatives(depth, is_discrete):
    program = relaxed(6, depth)
    if is_discrete:
        program.discretise()
    names, parameters = zip(*program.named_parameters(), strict=True)
    X = torch.randn(3, 2, dtype=torch.float64)

    def outputs(*values: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(program, dict(zip(names, values, strict=True)), (X,))

    assert torch.autograd.gradcheck(outputs, parameters)
    assert torch.autograd.gradgradcheck(outputs, parameters)


def test_every_level_starts_with_the_same_weight():
    program = RelaxedProgram(2, 1, 3, structure_penalty=0.0)
    per_level = [weights.sum().item() for weights in program.shares()[0].split([1, 2, 4, 8])]
    np.testing.assert_allclose(np.array(per_level) / [1, 2, 4, 8], 0.25, rtol=1e-5)
    deep = RelaxedProgram(2, 1, 3, structure_penalty=0.25).shares()[0][-1]
    assert deep < 0.25  # a penalty takes weight from the deepest level


def test_the_larger_weight_is_chosen_top_down():
    program = relaxed(1)
    with torch.no_grad():  # if at the root and its right child; the left child is C, what lies below it does not count
        program.architecture.copy_(torch.tensor([[0, 1], [1, 0], [-1, 2], [0, 5], [0, 5], [1, 1], [3, 2]]))
    program.discretise()
    assert program.structure.tolist() == [1, 0, 1, 1, 1, 0, 0]
    tree = program.harden()
    assert (tree.n_leaves, tree.depth) == (3, 2)
    np.testing.assert_allclose(tree.P, program.tests.detach().numpy()[[0, 2], :2])
    np.testing.assert_allclose(tree.c, program.maps.detach().numpy()[[1, 5, 6], :, -1])
    program.set_beta(1e4)
    X = clear_states(tree, 100)
    np.testing.assert_allclose(program(torch.tensor(X)).detach().numpy(), tree.forward(X), atol=1e-9)
    affine = relaxed(1)
    with torch.no_grad():
        affine.architecture[0, 0] = 9.0
    assert affine.harden().n_nodes == 0
    labels = affine.harden(otr.Argmax()).predict(X)
    np.testing.assert_array_equal(labels, affine.harden().forward(X).argmax(axis=1))


def test_a_chosen_structure_is_kept_and_survives_a_round_trip():
    program = relaxed(2)
    before = program.harden()
    program.discretise()
    with torch.no_grad():
        program.architecture.neg_()
    program.discretise()
    again = relaxed(3)
    again.load_state_dict(program.state_dict())
    X = torch.randn(20, 2, dtype=torch.float64)
    assert again.is_discrete and torch.equal(again(X), program(X))
    program(X).sum().backward()  # after the choice the program alone learns
    assert program.architecture.grad is None and program.tests.grad is not None and program.maps.grad is not None
    np.testing.assert_array_equal(again.harden().children_left, before.children_left)


@pytest.mark.parametrize(
    ("learns", "moving"),
    [("program", {"tests", "maps"}), ("architecture", {"architecture"}), ("all", {"tests", "maps", "architecture"})],
)
def test_frozen_parameters_get_no_gradients(learns, moving):
    program = relaxed(4)
    optimizer = torch.optim.Adam(program.parameters(), lr=0.1)
    X = torch.randn(20, 2, dtype=torch.float64)
    program(X).square().sum().backward()  # Adam's memory would move a parameter even where its gradient is zero
    optimizer.step()
    before = {name: parameter.detach().clone() for name, parameter in program.named_parameters()}
    program.learns = learns
    for _ in range(2):
        optimizer.zero_grad()
        program(X).square().sum().backward()
        optimizer.step()
    moved = {name for name, parameter in program.named_parameters() if not torch.equal(parameter, before[name])}
    assert moved == moving
