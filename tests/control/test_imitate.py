"""A tree that imitates a policy in one call: by every method, repeatable, with what it came to."""

import numpy as np
import pytest

import otr
from otr.core.smooth_network import SmoothNetwork

LOW, HIGH = [-2.0], [2.0]


def swinging(head):
    """Return a small policy with tanh units, which no tree equals."""
    generator = np.random.default_rng(0)
    n_outputs = 2 if head == otr.Argmax() else 1
    weights = [generator.normal(size=(8, 4)), generator.normal(size=(n_outputs, 8))]
    return SmoothNetwork(weights, [np.zeros(8), np.zeros(n_outputs)], activation="tanh", head=head)


def pendulum():
    generator = np.random.default_rng(1)
    weights = [generator.normal(size=(8, 3)), generator.normal(size=(1, 8))]
    return SmoothNetwork(weights, [np.zeros(8), np.zeros(1)], activation="tanh", head=otr.TanhBox(LOW, HIGH))


SHORT = {"n_rounds": 2, "n_episodes": 2, "n_choice_episodes": 3}


@pytest.mark.parametrize(("method", "options"), [("augtree", {}), ("viper", {"min_samples_leaf": 3}), ("lm_viper", {}),
                                                ("ndps", {"n_updates": 20}), ("distilled_otr", {})])  # fmt: skip
def test_labels_are_imitated_by_every_method(method, options, capsys):
    policy = swinging(otr.Argmax())
    tree = otr.imitate(policy, "CartPole-v1", method, 2, **SHORT, **options)
    assert isinstance(tree, otr.ObliqueTree) and tree.head.gives_labels
    said = capsys.readouterr().err
    assert f"imitate: {method} of depth 2, {tree.n_leaves:,} leaves: return" in said and "the policy's" in said
    states = otr.rollout("CartPole-v1", policy, n_episodes=2).states
    assert (tree.predict(states) == policy.predict(states)).mean() > 0.6


@pytest.mark.parametrize("method", ["augtree", "experts"])
def test_continuous_actions_stay_in_their_box_and_a_seed_repeats(method, capsys):
    options = {"n_updates": 50} if method == "experts" else {}
    trees = [otr.imitate(pendulum(), "Pendulum-v1", method, 2, **SHORT, progress=False, **options) for _ in range(2)]
    X = np.random.default_rng(0).normal(size=(50, 3)) * 5
    np.testing.assert_array_equal(trees[0].predict(X), trees[1].predict(X))
    assert np.abs(trees[0].predict(X)).max() <= 2 and capsys.readouterr().err == ""


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="method='cart', expected one of augtree, viper"):
        otr.imitate(pendulum(), "Pendulum-v1", "cart")
    with pytest.raises(TypeError, match="n_leaf"):
        otr.imitate(pendulum(), "Pendulum-v1", "viper", n_leaf=3)
    with pytest.raises(TypeError, match=r"smooth units; a tree can imitate it: otr\.imitate"):
        otr.tree(pendulum(), np.zeros((1, 3)))
