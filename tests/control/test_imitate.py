"""A tree that imitates a policy in one call: by every method, repeatable, with what it came to."""

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
import torch

import otr
from otr.control.critic_polish.learner import CriticPolish
from otr.core.black_box import BlackBox
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


@pytest.mark.parametrize("method", ["ndps", "distilled_otr"])
def test_critics_polish_alike_in_environments_by_name_by_function_and_as_they_are(
    method, tmp_path, monkeypatch, capsys
):
    stable_baselines3.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [16]}, seed=0).save(tmp_path / "sac")
    policy, critics = otr.read_policy(tmp_path / "sac.zip"), otr.read_critics(tmp_path / "sac.zip")
    short = {"steps": 80, "refill_steps": 100, "batch_size": 16, "n_candidates": 2, "n_selection_episodes": 2}
    n_threads, learnt, candidates = torch.get_num_threads(), [], CriticPolish.candidates

    def noting(self, *given):
        for step, found in candidates(self, *given):
            learnt.append((step, found))
            yield step, found
        rows = self._replay.gather(torch.arange(180).unsqueeze(0))
        restarts = (rows.states[0, 1:] != rows.next_states[0, :-1]).any(1).nonzero()[:, 0] + 1
        assert restarts.tolist() == [30, 60, 90, 100, 130, 160]  # at 100 the learning begins

    monkeypatch.setattr(CriticPolish, "candidates", noting)
    options = {"n_updates": 20, "max_steps": 30, **SHORT}
    plain = otr.imitate(policy, "Pendulum-v1", method, 2, **options)
    envs = ["Pendulum-v1", lambda: gym.make("Pendulum-v1"), gym.make("Pendulum-v1")]
    trees = [otr.imitate(policy, env, method, 2, polish={"critics": critics} | short, **options) for env in envs]
    assert [step for step, _ in learnt] == [{"ndps": 40, "distilled_otr": 64}[method], 80] * 3
    X = np.random.default_rng(0).normal(size=(50, 3))
    first, *others = ([found.predict(X) for _, found in learnt[i : i + 2]] for i in (0, 2, 4))
    np.testing.assert_array_equal([first, first], others)
    assert np.ptp([*first, plain.predict(X)], axis=0).max() > 1e-3
    np.testing.assert_array_equal(trees[0].predict(X), trees[2].predict(X))
    np.testing.assert_array_equal(trees[0].children_left, plain.children_left)
    said = capsys.readouterr().err
    assert said.count("imitate: polished, return ") + said.count("imitate: not polished") == 3
    assert torch.get_num_threads() == n_threads
    with pytest.raises(TypeError, match="actions that tanh or a clip leads into their box, not Argmax; use a search"):
        otr.imitate(swinging(otr.Argmax()), "CartPole-v1", polish=critics)
    with pytest.raises(ValueError, match="steps=0 is not at least 1"):
        otr.imitate(policy, "Pendulum-v1", polish={"critics": critics, "steps": 0})


class Keys(gym.Env):
    """A point that is pushed left or right, seen as a dictionary; actions are 1 and 2, and the middle is best."""

    observation_space = gym.spaces.Dict(
        {"speed": gym.spaces.Box(-9, 9, ()), "at": gym.spaces.Dict({"x": gym.spaces.Box(-9, 9, (2,))})}
    )
    action_space = gym.spaces.Discrete(2, start=1)

    def _seen(self):
        return {"speed": np.float32(0.0), "at": {"x": np.array([self.x, 1.0], dtype=np.float32)}}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = self.np_random.uniform(-3, 3), 0
        return self._seen(), {}

    def step(self, action):
        assert action in (1, 2)
        self.x, self.t = self.x + 0.5 * (2 * action - 3), self.t + 1
        return self._seen(), -abs(self.x), False, self.t == 10, {}


def test_a_black_box_in_an_environment_of_keys(capsys):
    """SiLU units and layer normalisation, observations that are a dictionary, labels from 1 on, a polish."""
    torch.manual_seed(0)
    steering = torch.nn.Linear(3, 4)
    last = torch.nn.Linear(4, 2)
    with torch.no_grad():
        steering.weight.copy_(torch.tensor([[1.0, 0, 0], [-1.0, 0, 0], [0, 1, 0], [0, 0, 1]]))
        last.weight.copy_(torch.tensor([[4.0, -4, 0, 0], [-4.0, 4, 0, 0]]))
    policy = otr.read_policy(torch.nn.Sequential(steering, torch.nn.SiLU(), torch.nn.LayerNorm(4), last))
    assert isinstance(policy, BlackBox) and policy.head == otr.Identity()
    best = otr.evaluate(Keys, policy, n_episodes=20, max_steps=10)
    for method, options in (("augtree", {}), ("distilled_otr", {"n_updates": 30})):
        polish = {"n_iterations": 2, "n_candidates": 1, "n_selection_episodes": 5}
        tree = otr.imitate(policy, Keys, method, 2, **SHORT, max_steps=10, polish=polish, **options)
        assert tree.feature_names == ("at_x0", "at_x1", "speed") and "at_x0" in otr.to_text(tree)
        assert otr.evaluate(Keys, tree, n_episodes=20, max_steps=10).mean_return > 1.2 * best.mean_return
    assert otr.rollout(Keys(), policy, n_episodes=2, max_steps=10).feature_names == ["at_x0", "at_x1", "speed"]
    assert "imitate: augtree of depth 2" in capsys.readouterr().err


def test_one_output_that_decides_between_two_labels():
    """As a binary classifier of scikit-learn has it: the linear policy that balances the pole."""
    falling = np.array([[0.05, 0.2, 1.0, 0.5]])
    policy = otr.ReluNetwork([np.vstack((falling, -falling)), [[1.0, -1.0]]], [np.zeros(2), [0.0]], head=otr.Sign())
    tree = otr.imitate(policy, "CartPole-v1", "lm_viper", 1, **SHORT, progress=False)
    states = otr.rollout("CartPole-v1", policy, n_episodes=2).states
    assert tree.head == otr.Argmax() and (tree.predict(states) == policy.predict(states)).mean() > 0.9


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="method='cart', expected one of augtree, viper"):
        otr.imitate(pendulum(), "Pendulum-v1", "cart")
    with pytest.raises(ValueError, match=r"depth=\[2, 2\], expected a number"):
        otr.imitate(pendulum(), "Pendulum-v1", "viper", [2, 2])
    for depth in (0, -1, 2.5, None, "3"):
        with pytest.raises(ValueError, match=r"depth=.*, expected a whole number from 1 on"):
            otr.imitate(pendulum(), "Pendulum-v1", "viper", depth)
    with pytest.raises(TypeError, match="n_leaf"):
        otr.imitate(pendulum(), "Pendulum-v1", "viper", n_leaf=3)
    with pytest.raises(TypeError, match=r"other units; a tree can imitate it: otr\.imitate"):
        otr.tree(pendulum(), np.zeros((1, 3)))
