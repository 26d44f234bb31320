"""Going on with a policy in the actor's place: its own actions, the oracle's play and critics, both kinds of heads."""

import dataclasses
import itertools

import gymnasium as gym
import numpy as np
import pytest
import torch

import otr
from otr.control.critic_polish.learner import CriticPolish
from otr.control.critic_polish.policy_actor import OraclePlay, PolicyActor, check_critics
from otr.control.environments import GymnasiumVectorEnv
from otr.control.sac.sac import FleetSac
from otr.control.sac.squashed_gaussian import ClippedActions
from otr.control.settings import CriticPolishSettings
from otr.core.smooth_network import SmoothNetwork
from otr.importers.critics import Critics

LOW, HIGH = np.array([-2.0]), np.array([2.0])
SHORT = CriticPolishSettings(60, 100, batch_size=32, first_neurons=6)
torch.set_num_threads(1)


def network(head, widths=(4,), scale=0.3, seed=0):
    generator = np.random.default_rng(seed)
    sizes = (3, *widths, 1)
    weights = [scale * generator.normal(size=(n, m)) for m, n in itertools.pairwise(sizes)]
    return otr.ReluNetwork(weights, [scale * generator.normal(size=n) for n in sizes[1:]], head=head)


def new_critics(n=2, width=16, **changes):
    generator = np.random.default_rng(5)

    def layers():
        shapes = [(4, width), (width, 1)]
        return [(generator.normal(size=(n, *shape)) / 4, generator.normal(size=(n, 1, shape[1]))) for shape in shapes]

    made = Critics(layers(), layers(), 0.9, 0.0, -2.0, generator.normal(size=(1, 9)) / 10)  # of an oracle [8]
    return dataclasses.replace(made, **changes)


def states(n=200):
    angle, rate = np.random.default_rng(1).uniform([-np.pi, -8], [np.pi, 8], (n, 2)).T
    return np.column_stack((np.cos(angle), np.sin(angle), rate))


def learning(policy, oracle=None, critics=None, settings=SHORT):
    envs = GymnasiumVectorEnv(lambda: gym.make("Pendulum-v1"))
    return CriticPolish(policy, envs, critics or new_critics(), oracle, settings, [3, 4, 5], free=False, tied=False)


@pytest.mark.parametrize("head", [otr.TanhBox(LOW, HIGH), otr.ClipBox([-1.0], [2.0])])
def test_the_mean_action_is_the_policy_s_and_deviations_begin_as_the_oracle_s(head):
    policy, X = network(head, (8,), scale=0.7, seed=3), states()
    log_stds = X @ [[0.1], [-0.2], [0.05]] - 2.0  # linear in the state, as the head is
    actor = PolicyActor(policy, X, log_stds, free=False)
    with torch.no_grad():
        means, found = actor(torch.from_numpy(X).float()).double().numpy().T
    low, high = head.limits(1)
    acted = np.tanh(means) if isinstance(head, otr.TanhBox) else np.clip(means, -1, 1)
    np.testing.assert_allclose(low + (acted + 1) / 2 * (high - low), policy.predict(X)[:, 0], atol=1e-5)
    np.testing.assert_allclose(found, log_stds[:, 0], atol=1e-5)
    assert np.abs(acted).max() > 0.99 and len(set(np.sign(means))) == 2


def test_critics_of_other_policies_are_refused():
    for other in (otr.Argmax(), otr.Identity()):
        with pytest.raises(TypeError, match=rf"not {type(other).__name__}; use a search"):
            check_critics(new_critics(), network(other))
    wider = otr.ReluNetwork([np.ones((1, 5))], [np.zeros(1)], head=otr.TanhBox(LOW, HIGH))
    with pytest.raises(ValueError, match="the critics read 4 numbers, expected 5 of a state and 1 of an action"):
        check_critics(new_critics(), wider)
    with pytest.raises(ValueError, match="of an actor whose last layer reads 8 numbers, not 4"):
        OraclePlay(network(otr.TanhBox(LOW, HIGH)), new_critics())


@pytest.mark.parametrize("smooth", [False, True])
def test_an_oracle_plays_as_its_network_with_its_deviations(smooth):
    oracle, X = network(otr.TanhBox([-1.0], [1.0]), (8,)), states()
    if smooth:
        oracle = SmoothNetwork(oracle.weights, oracle.biases, activation="tanh", head=oracle.head)
    critics, noise = new_critics(), np.random.default_rng(2).normal(size=(200, 1))
    played = OraclePlay(oracle, critics)
    np.testing.assert_allclose(played.act(X, 0 * noise), oracle.predict(X), atol=1e-12)
    z = X @ oracle.weights[0].T + oracle.biases[0]
    neurons = np.tanh(z) if smooth else np.maximum(z, 0)
    log_std = neurons @ critics.log_std[:, :-1].T + critics.log_std[:, -1]
    np.testing.assert_allclose(played.log_stds(X), log_std)
    expected = np.tanh(oracle.forward(X) + np.exp(log_std) * noise)
    np.testing.assert_allclose(played.act(X, noise), expected, atol=1e-12)
    without = OraclePlay(oracle, dataclasses.replace(critics, log_std=None))
    assert without.log_stds(X) is None
    np.testing.assert_allclose(without.act(X, noise), oracle.predict(X), atol=1e-12)


def test_gradients_of_clipped_actions_are_autograd_s_but_beyond_the_box_inwards_alone():
    generator = torch.Generator().manual_seed(0)
    answers, noise, weights = (torch.randn(1, 300, n, generator=generator) for n in (4, 2, 2))
    answers[..., 2:] *= 0.3
    actions, temperature = ClippedActions(1, 300, 2), torch.tensor([[0.3]])
    acted, log_probability = actions.sample(answers, noise), actions.log_probability(answers, noise)
    out = torch.zeros(1, 300, 4)
    actions.gradient(answers, noise, temperature, weights / 300, out)
    free = answers.clone().requires_grad_()
    mean, log_std = free.chunk(2, 2)
    normal = torch.distributions.Normal(mean, log_std.exp())
    unclipped = mean + log_std.exp() * noise
    expected = normal.log_prob(unclipped).sum(2)
    torch.testing.assert_close(log_probability, expected.detach())
    torch.testing.assert_close(acted, unclipped.detach().clamp(-1, 1))
    inwards = (unclipped.abs() <= 1) | (unclipped * weights > 0)
    loss = (0.3 * expected + (weights * unclipped * inwards).sum(2)).mean()
    torch.testing.assert_close(out, torch.autograd.grad(loss, free)[0])
    assert 0.1 < (~inwards).float().mean() < 0.4
    torch.testing.assert_close(actions.sample(answers, None), answers[..., :2].clamp(-1, 1))


def test_the_buffer_is_filled_by_the_oracle_then_by_the_policy():
    oracle = network(otr.TanhBox(LOW, HIGH), (8,), 1.0)
    constant = otr.ObliqueTree([], [], np.zeros((0, 3)), [], np.zeros((1, 1, 3)), [[1.5]], head=otr.ClipBox(LOW, HIGH))
    critics = new_critics(log_std=np.full((1, 9), -20.0) * (np.arange(9) == 8))  # next to no noise
    settings = CriticPolishSettings(60, 100, student_share=0.3, refill_noise=0.0, batch_size=32)
    made = learning(constant, oracle, critics, settings)
    learner = made._filled()
    rows = made._replay.gather(torch.arange(100).unsqueeze(0))
    X, acted = rows.states[0].double().numpy(), rows.actions[0].double().numpy()
    np.testing.assert_allclose(2 * acted[:70], oracle.predict(X[:70]), atol=1e-4)
    assert np.abs(acted[70:] - 0.75).max() < 0.1 and np.ptp(acted[:70]) > 0.2
    np.testing.assert_array_equal(X[1:], rows.next_states[0, :-1].double().numpy())
    assert rows.rewards.max() <= 0.0 and rows.continues.min() == 1.0
    for ours, theirs in ((learner.critics, critics.layers), (learner.targets, critics.targets)):
        for i, (weight, bias) in enumerate(theirs):
            np.testing.assert_allclose(ours.weights[i], weight, atol=1e-6)
            np.testing.assert_allclose(ours.biases[i], bias, atol=1e-6)
    assert float(learner.log_temperature) == -2.0 and learner.n_updates == 0
    critics = new_critics(1, log_temperature=None, log_std=None)  # DDPG's stands for both and gets a temperature
    learner = learning(network(otr.TanhBox(LOW, HIGH)), oracle, critics)._filled()
    assert float(learner.log_temperature.exp()) == pytest.approx(0.05)
    for weight, (theirs, _) in zip(learner.critics.weights, critics.layers, strict=True):
        np.testing.assert_allclose(weight[0], theirs[0], atol=1e-6)
        np.testing.assert_array_equal(weight[0], weight[1])


@pytest.mark.parametrize("head", [otr.TanhBox(LOW, HIGH), otr.ClipBox(LOW, HIGH)])
@pytest.mark.parametrize("kind", ["network", "tree", "alone"])
def test_candidates_keep_head_structure_and_zeros_and_come_again_bit_for_bit(kind, head):
    policy = network(head)
    if kind != "network":
        M = np.array([[[0.5, 0.0, 0.1]], [[0.0, 0.2, 0.0]]])
        policy = otr.ObliqueTree([~0], [~1], [[0.0, 1.0, 0.3]], [0.1], M, [[0.0], [0.4]], head=head)
    oracle = None if kind == "alone" else network(otr.TanhBox(LOW, HIGH), (8,))
    found = list(learning(policy, oracle).candidates(3, print))
    assert [step for step, _ in found] == ([44, 52, 60] if kind == "network" else [20, 40, 60])
    for _, candidate in found:
        assert getattr(candidate, "hidden_widths", None) == getattr(policy, "hidden_widths", None)
        assert type(candidate) is type(policy) and candidate.head == head
        if isinstance(policy, otr.ObliqueTree):
            ours, theirs = candidate.leaf_forms, policy.leaf_forms
            np.testing.assert_array_equal(ours == 0, theirs == 0)
            assert (ours != theirs)[theirs != 0].all() and (candidate.v != policy.v).all() and candidate.P[0, 0] == 0
    X = states()
    changes = [np.abs(candidate.predict(X) - policy.predict(X)).max() for _, candidate in found]
    assert min(changes) > 0 and max(changes) < 3 and len(set(changes)) == 3
    again = list(learning(policy, oracle).candidates(3, print))
    for (_, one), (_, other) in zip(found, again, strict=True):
        np.testing.assert_array_equal(one.predict(X), other.predict(X))


def test_learning_rates_fall_once_a_widened_network_is_as_narrow_as_before(monkeypatch):
    shares = []
    monkeypatch.setattr(FleetSac, "at_step", lambda _, __, share: shares.append(share))
    for n_neurons in (6, 0):
        settings = CriticPolishSettings(400, 100, batch_size=8, first_neurons=n_neurons)
        list(learning(network(otr.TanhBox(LOW, HIGH)), None, settings=settings).candidates(2, print))
    np.testing.assert_allclose(shares, [*np.ones(240), *np.linspace(1.0, 0.1, 161)[:-1], *np.ones(400)])


def test_a_network_of_fewer_neurons_is_widened_and_loses_them_one_by_one(monkeypatch):
    narrow, seen, said = CriticPolish._narrow, [], []
    made = learning(network(otr.TanhBox(LOW, HIGH)), settings=dataclasses.replace(SHORT, first_neurons=8))

    def noted(self, learner, n_neurons):
        before = self._actor.policy.policy().n_hidden
        narrow(self, learner, n_neurons)
        seen.append((self._n_rows - SHORT.refill_steps, before, n_neurons))

    monkeypatch.setattr(CriticPolish, "_narrow", noted)
    assert {candidate.n_hidden for _, candidate in made.candidates(3, said.append)} == {4}
    assert said[0] == "15 of 60 steps, 8 neurons" and said[-1] == "36 of 60 steps, 5 neurons"
    steps = [step for step, _, _ in seen]
    assert [widths for _, *widths in seen] == [[8, 7], [7, 6], [6, 5], [5, 4]]
    assert steps == sorted(set(steps)) and 12 < steps[0] < steps[-1] == 36
    seen.clear()
    made = learning(network(otr.TanhBox(LOW, HIGH)), settings=dataclasses.replace(SHORT, first_neurons=0))
    assert [step for step, _ in made.candidates(3, print)] == [20, 40, 60] and not seen


def test_critics_learn_towards_no_more_than_the_highest_discounted_rewards_that_were_played(monkeypatch):
    seen, update, policy = [], FleetSac.update, network(otr.TanhBox(LOW, HIGH))

    def noted(self, batch, noise):
        seen.append((float(self.highest_value), made._discounted))
        update(self, batch, noise)

    monkeypatch.setattr(FleetSac, "update", noted)
    settings = CriticPolishSettings(300, 250, batch_size=8, first_neurons=0, bounds_values=True)  # of 200-step episodes
    made = learning(policy, settings=settings)
    list(made.candidates(1, print))
    best, discounted, expected = -np.inf, 0.0, []
    for t, reward in enumerate(made._replay.gather(torch.arange(550).unsqueeze(0)).rewards[0].tolist()):
        discounted = reward + 0.9 * discounted
        best = max(best, discounted)
        discounted *= t not in (199, 249, 449)
        expected.append((best, discounted))
    np.testing.assert_allclose(seen, expected[250:], rtol=1e-6)
    assert len({best for best, _ in seen}) > 1
    seen.clear()
    made = learning(policy, settings=dataclasses.replace(settings, bounds_values=False))
    list(made.candidates(1, print))
    assert {best for best, _ in seen} == {np.inf}


def test_learning_that_diverges_ends_and_leaves_what_came_before():
    settings = CriticPolishSettings(60, 100, batch_size=32, learning_rate=10.0, first_neurons=0)
    critics = new_critics(layers=[(np.full((2, 4, 16), 1e20), np.zeros((2, 1, 16))), new_critics().layers[1]])
    made = learning(network(otr.TanhBox(LOW, HIGH)), None, critics, settings)
    said = []
    assert list(made.candidates(3, said.append)) == []
    assert said == ["numbers are no longer finite after 20 steps, which ends the polish"]
