"""Episodes that the library plays: against one environment stepped by hand, and what is no policy or environment."""

import functools
import warnings
from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest
from sklearn.tree import DecisionTreeClassifier

import otr
from otr.control.environments import GymnasiumVectorEnv
from otr.control.rollout import play_side_by_side

evaluate = functools.partial(otr.evaluate, max_steps=1000)  # of environments that have no limit of their own
rollout = functools.partial(otr.rollout, max_steps=1000)


class Walk(gym.Env):
    """Each step adds the action to a seeded start; the return is the sum of the places; ends where |x| > 4."""

    observation_space = gym.spaces.Box(-9, 9, (2, 1), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    n_made = 0

    def __init__(self) -> None:
        type(self).n_made += 1
        self.state = np.ones((2, 1))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        super().reset(seed=seed)
        self.state[0, 0] = self.np_random.uniform(-1, 1)
        return self.state, {}  # which it writes into again

    def step(self, action: np.ndarray) -> tuple:
        assert action.dtype == np.float32 and action.shape == (1,)
        self.state[0, 0] += float(action[0])
        x = float(self.state[0, 0])
        return self.state, x, abs(x) > 4, False, {}


class Labels(Walk):
    action_space = gym.spaces.Discrete(3)

    def step(self, action: int) -> tuple:
        return super().step(np.array([action / 4], np.float32))


class Bytes(Walk):
    action_space = gym.spaces.Box(0, 10, (1,), np.uint8)

    def step(self, action: np.ndarray) -> tuple:
        assert action.dtype == np.uint8
        return super().step(action.astype(np.float32))


class LabelsFromOne(Walk):
    action_space = gym.spaces.Discrete(3, start=1)


class Words(Walk):
    observation_space = gym.spaces.Text(5)


class Pixels(Walk):
    observation_space = gym.spaces.Box(0, 255, (4, 4, 3), np.uint8)


class Switches(Walk):
    action_space = gym.spaces.MultiDiscrete([2, 3])


def right(X: np.ndarray) -> np.ndarray:
    return np.full((len(X), 1), 1 / 3)


LABELS = otr.parse_program("if a <= 0: left else: right", ["a", "b"], labels=True, output_names=["left", "right"])


def by_hand(env: gym.Env, act, seed: int) -> tuple[float, list, list]:
    observation, _ = env.reset(seed=seed)
    total, states, actions, ended = 0.0, [], [], False
    while not ended:
        states.append(np.array(observation, dtype=np.float64).ravel())
        actions.append(act(states[-1]))
        observation, reward, terminated, truncated, _ = env.step(actions[-1])
        total, ended = total + float(reward), terminated or truncated
    return total, states, actions


def test_episodes_are_those_of_one_environment_stepped_by_hand():
    """More episodes than environments side by side, so that some are played one after another."""
    played = evaluate(Walk, right, range(100))
    rows = [by_hand(Walk(), lambda _: np.array([1 / 3], np.float32), seed) for seed in range(100)]
    assert played.returns.tolist() == [total for total, *_ in rows]
    assert played.lengths.tolist() == [len(states) for _, states, _ in rows]
    assert played.terminated.all() and not played.truncated.any()
    assert (played.states.shape, played.actions.shape) == ((0, 2), (0, 1))
    mean, std = np.mean(played.returns), np.std(played.returns)
    assert (played.mean_return, played.std_return) == pytest.approx((mean, std))
    assert repr(played) == f"Rollout(return {mean:.4g} ± {std:.4g} over 100 episodes, {played.lengths.sum():,} steps)"


def test_many_policies_play_their_episodes_in_one_loop():
    """The policy reads which episodes its states are of; steps come as they were played, or episode after episode."""
    steps = np.array([1 / 3, 1 / 2, 1.0], np.float32)

    def act(X: np.ndarray, episodes: np.ndarray) -> np.ndarray:
        return steps[episodes % 3][:, None]

    played = {}
    for sort_steps in (True, False):
        with closing(GymnasiumVectorEnv(Walk)) as envs:
            played[sort_steps] = play_side_by_side(
                envs, act, range(10), n_envs=4, alive_bonus=1.0, keep_steps=True, sort_steps=sort_steps
            )
    rows = [by_hand(Walk(), lambda _, i=seed: steps[[i % 3]], seed) for seed in range(10)]
    assert played[True].lengths.tolist() == [len(states) for _, states, _ in rows]
    np.testing.assert_allclose(played[True].returns, [total - len(states) for total, states, _ in rows], atol=1e-9)
    np.testing.assert_array_equal(played[True].states, np.concatenate([states for _, states, _ in rows]))
    np.testing.assert_array_equal(played[True].actions, np.concatenate([actions for *_, actions in rows]))
    first = [states[0] for _, states, _ in rows[:4]]
    np.testing.assert_array_equal(played[False].states[:4], first)
    ours, theirs = (np.sort(each.states[:, 0]) for each in played.values())
    np.testing.assert_array_equal(ours, theirs)


def test_a_tree_in_a_registered_environment():
    network = otr.ReluNetwork([np.ones((2, 4)), [[-1, 0.5], [1, 0.2]]], [[0.01, -0.02], [0, 0]], head=otr.Argmax())
    tree = otr.map_network(network)
    played = otr.rollout("CartPole-v1", tree, 40, seed=1)
    rows = [by_hand(gym.make("CartPole-v1"), lambda x: int(tree.predict(x)), int(seed)) for seed in played.seeds]
    assert played.returns.tolist() == [total for total, *_ in rows]
    np.testing.assert_array_equal(played.states, np.concatenate([states for _, states, _ in rows]))
    np.testing.assert_array_equal(played.actions, np.concatenate([actions for *_, actions in rows]))
    assert len(set(played.actions.tolist())) == 2
    again = otr.evaluate("CartPole-v1", network, played.seeds)
    np.testing.assert_array_equal(again.returns, played.returns)


def test_a_limit_truncates_and_the_seed_never_meets_the_reported_episodes():
    played = otr.rollout(Walk, lambda X: np.zeros((len(X), 1)), 3, max_steps=7)
    assert played.lengths.tolist() == [7, 7, 7] and played.truncated.all() and not played.terminated.any()
    assert len(played.states) == len(played.actions) == 21
    one, two, other = (rollout(Walk, right, 5, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.states, two.states)
    assert not set(one.seeds.tolist()) & set(other.seeds.tolist())
    assert min(one.seeds.min(), other.seeds.min()) >= 2**20 > len(evaluate(Walk, right).seeds) == 100
    assert evaluate(Walk, right, n_episodes=3).seeds.tolist() == [0, 1, 2] and len(rollout(Walk, right).seeds) == 100
    assert evaluate(Walk, right, [4], n_episodes=1).returns == rollout(Walk, right, seeds=[4]).returns


@pytest.mark.parametrize(
    ("env", "policy", "message"),
    [
        (Walk, lambda X: np.zeros((len(X), 2)), r"an array of shape \(5, 2\).*expected finite actions \(n, 1\)"),
        (Walk, lambda X: np.full((len(X), 1), np.nan), r"first \[nan\], expected finite actions \(n, 1\)"),
        (Walk, lambda X: np.ones((2 * len(X), 1)), r"\(10, 1\).*expected finite actions \(n, 1\) for n = 5 states"),
        (Walk, lambda X: 0.5, r"of shape \(\).*first \[0.5\], expected finite actions \(n, 1\) for n = 5 states"),
        (Walk, lambda X: np.zeros((0, 1)), r"of shape \(0, 1\).*first \[\], expected finite"),
        (Walk, lambda X: (np.zeros((len(X), 1)), None), r"a tuple of 2.*deterministic=True\)\[0\]"),
        (Walk, LABELS, r"labels, an array of shape \(5,\).*takes real actions \(n, 1\)"),
        (Labels, lambda X: np.zeros(len(X)), r"type float64.*expected labels \(n,\) from 0 to 2"),
        (Labels, lambda X: np.full(len(X), 3), r"first \[3\], expected labels \(n,\) from 0 to 2"),
        (Labels, lambda X: np.ones(1, int), r"of shape \(1,\).*expected labels \(n,\) from 0 to 2 for n = 5 states"),
        (Labels, lambda X: np.zeros(0, int), r"of shape \(0,\).*first \[\], expected labels"),
        (LabelsFromOne, right, r"type float64.*expected labels \(n,\) from 0 to 2"),
        (Words, right, r"the observations are Text\(.*which no vector of one length holds"),
        (Pixels, right, r"the observations are images, Box\(0, 255, \(4, 4, 3\), uint8\), and image policies are out"),
        (Switches, right, r"MultiDiscrete\(\[2 3\]\), several labels .* of 6 labels.*unravel_index\(label"),
        (Bytes, lambda X: np.full((len(X), 1), -3.0), "actions are of type uint8, from 0 to 255"),
        (Bytes, lambda X: np.full((len(X), 1), 300.0), "actions are of type uint8, from 0 to 255"),
    ],
)
def test_what_is_no_action_or_no_space(env, policy, message):
    with pytest.raises(ValueError, match=message):
        rollout(env, policy, 5)


def test_whole_actions_of_a_box_and_policies_of_other_kinds():
    assert set(rollout(Bytes, lambda X: np.full((len(X), 1), 1.4), 1).actions.ravel().tolist()) == {1}
    assert evaluate(Bytes, lambda X: np.ones(len(X), int), [0]).lengths.tolist() == [4]
    learned = DecisionTreeClassifier().fit([[0.0, 1.0], [1.0, 1.0]], [1, 2])
    played = rollout(Labels, learned, 4)
    np.testing.assert_array_equal(played.actions, learned.predict(played.states))
    functions = rollout(functools.partial(Labels), learned.predict, 4)
    np.testing.assert_array_equal(functions.returns, played.returns)

    class Doubling(Walk):
        def step(self, action: np.ndarray) -> tuple:
            action *= 2.0  # in place: the actions are kept as they were
            return super().step(action)

    played = otr.rollout(Doubling, right, 2, max_steps=3)
    np.testing.assert_array_equal(played.actions, np.full((6, 1), 1 / 3, np.float32))


def test_what_is_no_environment_or_policy():
    one = Walk()
    for play, error, message in (
        (lambda: evaluate(3, right), TypeError, "env is a int, expected an environment, the id of one, or a function"),
        (lambda: evaluate(lambda: one, right), ValueError, "made the same environment twice"),
        (lambda: evaluate(Walk, 3), TypeError, "policy is a int, expected a tree"),
        (lambda: rollout(Walk, right, 0), ValueError, "n_episodes is 0"),
        (lambda: evaluate(Walk, right, n_episodes=0), ValueError, "n_episodes is 0"),
        (lambda: otr.evaluate(Walk, right, max_steps=0), ValueError, "max_steps is 0, expected 1 or more"),
        (lambda: evaluate(Walk, right, []), ValueError, "there are no seeds"),
        (lambda: evaluate(Walk, right, [1, 2], n_episodes=3), ValueError, "n_episodes is 3, and there are 2 seeds"),
        (lambda: rollout(Walk, right, seeds=[1], n_episodes=3), ValueError, "n_episodes is 3, and there are 1 seeds"),
    ):
        with pytest.raises(error, match=message):
            play()


def test_environments_are_side_by_side_and_closed_at_the_end():
    closed = []

    class Closing(Walk):
        n_made = 0

        def close(self) -> None:
            closed.append(self)

    n_looked_at = 4  # one for its spaces, three to see whether episodes depend on those before
    evaluate(Closing, right, range(50))
    assert Closing.n_made == len(closed) == 32 + n_looked_at

    def fails(X: np.ndarray) -> np.ndarray:
        raise RuntimeError("no answer")

    with pytest.raises(RuntimeError, match="no answer"):
        evaluate(Closing, fails, range(3))
    assert Closing.n_made == len(closed) == 35 + 2 * n_looked_at


def test_observations_and_rewards_that_are_no_numbers_are_reported():
    class Broken(Walk):
        answer: tuple

        def step(self, action):
            return (*self.answer, False, False, {})

    for Broken.answer, message in (
        (([[0], [np.nan]], 1.0), r"the observation of the episode of seed 7 at step 1 is not finite: \[0.0, nan\]"),
        (([[0], [1]], np.inf), "the rewards of the episode of seed 7 add up to inf"),
    ):
        with pytest.raises(ValueError, match=message):
            otr.evaluate(Broken, right, [7], max_steps=5)


class Worn(Walk):
    def __init__(self) -> None:
        super().__init__()
        self.n_played = 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        self.n_played += 1
        return super().reset(seed=seed)

    def step(self, action: np.ndarray) -> tuple:
        return super().step(action * np.float32(self.n_played))


class Random(Walk):
    def step(self, action: np.ndarray) -> tuple:
        return super().step(action * np.random.default_rng().random(dtype=np.float32))


def test_an_environment_that_keeps_a_past_is_made_anew_for_every_episode():
    with pytest.warns(UserWarning, match="Worn: its episodes depend on those that it played before; it is recreated"):
        played = evaluate(Worn, right, range(50))
    assert played.returns.tolist() == evaluate(Walk, right, range(50)).returns.tolist()
    with pytest.raises(ValueError, match="a seed does not decide one: give a function that makes the environment"):
        evaluate(Worn(), right, range(2))
    with warnings.catch_warnings(action="error"):  # recreating it would not help
        evaluate(Random, right, range(2))


def test_an_environment_is_stepped_alone_and_left_open():
    closed = []

    class Closing(Walk):
        def close(self) -> None:
            closed.append(self)

    for play, n in ((evaluate, 40), (rollout, 3)):
        assert play(Closing(), right, n_episodes=n).returns.tolist() == play(Walk, right, n_episodes=n).returns.tolist()
    assert not closed


def test_the_biped_plays_an_episode_as_its_seed_says_whatever_was_played_before():
    """In gymnasium 1.4.0 four of these six episodes depend on those before, by up to 6 in the return."""

    def act(X: np.ndarray) -> np.ndarray:
        return np.sin(1e4 * X[:, :4])

    alone = [otr.evaluate("BipedalWalker-v3", act, [seed], max_steps=100).returns[0] for seed in range(6)]
    env = gym.make("BipedalWalker-v3")
    assert otr.evaluate(env, act, range(6), max_steps=100).returns.tolist() == alone
    again = otr.evaluate("BipedalWalker-v3", act, [*range(20, 52), *range(6)], max_steps=100)  # 32 are side by side
    assert again.returns[32:].tolist() == alone


def test_episodes_without_a_limit_are_refused():
    for env in (Walk, Walk(), lambda: gym.wrappers.TransformReward(Walk(), lambda reward: reward)):
        with pytest.raises(ValueError, match="Walk: episodes have no limit, so one may never end; give one as max_st"):
            otr.evaluate(env, right, [0])
    limited = otr.evaluate(lambda: gym.wrappers.TimeLimit(Walk(), 3), right, [0])
    assert limited.lengths.tolist() == [3] and limited.truncated.all()


@pytest.mark.parametrize(
    ("reset", "step", "message"),
    [
        (None, (np.zeros(2), np.array([1.0]), True, False, {}), r"step\(action\) returns the reward array\(\[1.\]\)"),
        (None, (np.zeros(2), 1.0, True, {}), r"step\(action\) .*4.* truncated, info\)"),
        (None, None, r"step\(action\) .*NoneType"),
        (np.zeros(2), None, r"reset\(seed=0\) fails: ValueError: .* returns \(observation, info\)"),
        (TypeError("no argument seed"), None, r"reset\(seed=0\) fails: TypeError: no argument seed\. In gymnasium"),
    ],
)
def test_another_interface_is_named(reset, step, message):
    class Other(Walk):
        def reset(self, *, seed=None, options=None):
            if isinstance(reset, Exception):
                raise reset
            return super().reset(seed=seed) if reset is None else np.zeros(3)

        def step(self, action):
            return step

    with pytest.raises(ValueError, match=message):
        evaluate(Other, right, [0])
