"""The fit of a student network: its gradient, what it finds again, and the box and the labels of its answers."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime

import otr
from otr.control import DaggerSettings, StudentFit, run_dagger
from otr.control.distilled_otr import _Loss
from otr.control.search.small_networks import NetworkShape
from tests.control.worlds import PointMass, continuous_oracle, episode_seeds

BOX = (np.array([-2.0, -1.0]), np.array([2.0, 3.0]))
CLIP = otr.ClipBox(*BOX)


def states(n, seed=0, d=3):
    return np.random.default_rng(seed).normal(size=(n, d)) * [1.0, 5.0, 0.1][:d] + [0.0, 20.0, -1.0][:d]


def teacher(head, widths=(4,), seed=4, size=1.0):
    """A network of two answers beside a linear map, which its neurons bend within the states above."""
    shape = NetworkShape(3, widths, 2, BOX if isinstance(head, otr.ClipBox) else None, "input")
    vector = np.random.default_rng(seed).normal(size=shape.n_numbers) * size
    return shape.network(vector, [0.0, 20.0, -1.0], [1.0, 5.0, 0.1])


def fitted(fit, X, oracle, seed=3):
    answers = oracle.forward(X) if oracle.head.gives_labels else oracle.predict(X)
    return fit(X, answers, None, np.random.default_rng(seed))


@pytest.mark.parametrize("widths", [(), (3,), (3, 2)])
@pytest.mark.parametrize(("dense", "slope"), [("input", 0.0), (False, 0.1)])
@pytest.mark.parametrize("box", [None, BOX])
def test_the_gradient_is_that_of_the_loss(widths, dense, slope, box):
    generator = np.random.default_rng(0)
    shape = NetworkShape(3, widths, 2, box, dense, slope)
    loss = _Loss.of(shape, generator.normal(size=(20, 3)), 3 * generator.normal(size=(20, 2)), ridge=0.01)
    vector = generator.normal(size=shape.n_numbers)
    value, gradient = loss.value_and_gradient(vector)
    numeric = approx_fprime(vector, lambda v: loss.value_and_gradient(v)[0], 1e-7)
    np.testing.assert_allclose(gradient, numeric, atol=2e-5)
    assert value > 0.005 * vector @ vector


def test_a_linear_oracle_is_found_again():
    """Also where it is clipped: an answer at the edge says no more than that the edge is reached."""
    oracle = teacher(CLIP, (), size=2.0)
    X = states(2000)
    at_edge = np.mean((oracle.predict(X) == BOX[0]) | (oracle.predict(X) == BOX[1]))
    assert 0.3 < at_edge < 0.9
    student = fitted(StudentFit(CLIP, (), ridge=1e-9), X, oracle).network
    assert student.head == CLIP and student.hidden_widths == ()
    np.testing.assert_allclose(student.weights[0], oracle.weights[0], rtol=0.02, atol=0.02)


@pytest.mark.parametrize("size", [0.0, 0.1, 1e9 / 3])
def test_a_constant_input_gets_no_large_weight(size):
    """The mean of 0.1 or of a third of 1e9 is rounded, so that the standard deviation need not be zero."""
    oracle, X = teacher(CLIP), states(700)
    X = np.column_stack((X, np.full(len(X), size)))
    answers = oracle.predict(X[:, :3])
    student = StudentFit(CLIP, (2,), n_updates=20)(X, answers, None, np.random.default_rng(3)).network
    assert np.abs(student.weights[0][:, 3]).max() < 10.0
    assert np.abs(student.weights[1][:, 2 + 3]).max() < 10.0


@pytest.mark.parametrize("head", [CLIP, otr.Argmax()], ids=["box", "labels"])
def test_a_network_of_as_many_neurons_is_imitated_where_a_linear_policy_cannot(head):
    oracle, X, fresh = teacher(head), states(4000), states(1000, seed=9)

    def error(widths):
        tree = fitted(StudentFit(head, widths, n_starts=4, n_updates=300, ridge=0.0), X, oracle)
        assert isinstance(tree, otr.PatternTree) and tree.network.dense == ("input" if widths else False)
        return np.abs(tree.predict(fresh) - oracle.predict(fresh)).mean()

    assert error((4,)) < 0.01 < 0.03 < error(())


def test_the_same_seed_gives_the_same_student_and_rows_are_drawn():
    X, oracle, fit = states(600), teacher(CLIP), StudentFit(CLIP, (2,), max_samples=100, n_updates=20)
    one, two, other = (fitted(fit, X, oracle, seed).network for seed in (3, 3, 4))
    for layer in range(2):
        np.testing.assert_array_equal(one.weights[layer], two.weights[layer])
    assert not np.array_equal(one.weights[0], other.weights[0])
    with pytest.raises(ValueError, match="expected Argmax or a ClipBox with finite limits"):
        fitted(StudentFit(otr.Identity(), (2,)), X, teacher(CLIP))


def test_dagger_with_students_goes_on_after_a_kill(tmp_path):
    oracle = continuous_oracle()
    fit = StudentFit(otr.ClipBox(-1.0, 1.0), (2,), max_samples=60, n_updates=20)
    settings = DaggerSettings(n_rounds=3, n_episodes=4, n_initial_episodes=3, n_choice_episodes=11)
    seed = np.random.SeedSequence(7)

    def run(folder, play):
        return run_dagger(oracle, fit, play, episode_seeds, settings, seed, folder)

    whole = run(tmp_path / "whole", PointMass(continuous=True))
    with pytest.raises(InterruptedError):
        run(tmp_path / "killed", PointMass(continuous=True, fail_at=3))
    again = run(tmp_path / "killed", PointMass(continuous=True))
    assert isinstance(again.tree, otr.PatternTree) and (again.iterates[0].n_leaves, again.iterates[0].depth) == (4, 2)
    np.testing.assert_array_equal(again.tree.network.weights[0], whole.tree.network.weights[0])
    X = np.random.default_rng(0).normal(size=(500, 2))
    assert np.abs(again.tree.predict(X) - oracle.predict(X)).mean() < 0.05
