"""The batched soft actor-critic: the gradients of autograd, the numbers of Stable-Baselines3, and every run on its own.

Both are compared in float64: in float32 fifty updates multiply a rounding error by thousands, as they do from one
processor to another, and no bound would tell that from a mistake.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import Tensor

from otr.control.sac.actors import FleetActors
from otr.control.sac.adam import RunSettings
from otr.control.sac.mlp import Layers, StackedMlp, new_layers
from otr.control.sac.sac import FleetSac, Minibatch, Shapes
from otr.control.sac.stacked_tensors import multiply, new_stack
from tests.control.sac.autograd_sac import AutogradSac, linears, mlp

N_INPUTS, N_ACTIONS, BATCH = 11, 3, 100


def draw_batch(generator: torch.Generator) -> tuple[Minibatch, Tensor]:
    """Return one run's transitions, (B, .) each, and the noise (2 B, n_actions) of one update."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    parts = normal(BATCH, N_INPUTS), normal(BATCH, N_ACTIONS).tanh(), normal(BATCH), normal(BATCH, N_INPUTS)
    continues = (torch.rand(BATCH, generator=generator) > 0.1).to(torch.get_default_dtype())
    return Minibatch(*parts, continues), normal(2 * BATCH, N_ACTIONS)


def stacked(drawn: list[tuple[Minibatch, Tensor]]) -> tuple[Minibatch, Tensor]:
    fields = ("states", "actions", "rewards", "next_states", "continues")
    batch = Minibatch(*(torch.stack([getattr(one, field) for one, _ in drawn]) for field in fields))
    return batch, torch.stack([noise for _, noise in drawn])


def learn(fleet: FleetSac, seeds: list[int], n_updates: int, rate_end: float = 1.0) -> None:
    generators = [torch.Generator().manual_seed(1000 + seed) for seed in seeds]
    for n_done in range(n_updates):
        fleet.at_step(200 * n_done, 1 - (1 - rate_end) * n_done / n_updates)
        fleet.update(*stacked([draw_batch(generator) for generator in generators]))


def new_fleet(
    shapes: Shapes, seeds: list[int], settings: list[RunSettings] | None = None, actor: FleetActors | None = None
) -> FleetSac:
    fleet = FleetSac(shapes, settings or [RunSettings(1e-3, 0.99)] * len(seeds), actor=actor)
    for run, seed in enumerate(seeds):
        fleet.initialise(run, torch.Generator().manual_seed(seed))
    return fleet


class Box11x3(gym.Env):
    """An environment that is never stepped: its spaces alone matter."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (N_INPUTS,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (N_ACTIONS,), np.float32)

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
        return np.zeros(N_INPUTS, np.float32), {}


def network_parameters(actor: Any) -> dict[str, Tensor]:
    heads = [actor.mu, actor.log_std]
    hidden = [layer for layer in actor.latent_pi if isinstance(layer, torch.nn.Linear)]
    found = {f"actor.weight{i}": layer.weight.T for i, layer in enumerate(hidden)}
    found |= {f"actor.bias{i}": layer.bias for i, layer in enumerate(hidden)}
    found[f"actor.weight{len(hidden)}"] = torch.cat([head.weight for head in heads]).T
    found[f"actor.bias{len(hidden)}"] = torch.cat([head.bias for head in heads])
    return found


def sb3_parameters(model: SAC, of_actor: Callable[[Any], dict[str, Tensor]]) -> dict[str, Tensor]:
    policy = model.policy
    found = of_actor(policy.actor)
    for name, critic in (("critics", policy.critic), ("targets", policy.critic_target)):
        nets = [[layer for layer in net if isinstance(layer, torch.nn.Linear)] for net in critic.q_networks]
        for i in range(len(nets[0])):
            found[f"{name}.weight{i}"] = torch.stack([net[i].weight.T for net in nets])
            found[f"{name}.bias{i}"] = torch.stack([net[i].bias for net in nets]).unsqueeze(1)
    found["log_temperature"] = model.log_ent_coef
    return {name: tensor.detach().clone() for name, tensor in found.items()}


@contextmanager
def float64() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("dense", [False, True], ids=["layered", "dense"])
@pytest.mark.parametrize("actor", [(), (6,), (8, 8)], ids=str)
@pytest.mark.parametrize(("slope", "decay", "temperature"), [(0.05, 1e-2, None), (0.0, 0.0, 0.2)])
def test_gradients_are_those_of_autograd(actor, slope, decay, temperature, dense) -> None:  # type: ignore[no-untyped-def]
    shapes = Shapes(N_INPUTS, N_ACTIONS, actor, (64, 64), BATCH, negative_slope=slope, tau=0.01, dense=dense)
    assert_learns_as_autograd(shapes, RunSettings(1e-3, 0.98, decay, temperature))


@pytest.mark.parametrize("delay", [1, 3])
def test_falling_learning_rates_and_delayed_actors_are_those_of_autograd(delay: int) -> None:
    shapes = Shapes(N_INPUTS, N_ACTIONS, (6,), (64, 48), BATCH, negative_slope=0.05, tau=0.01, actor_delay=delay)
    assert_learns_as_autograd(shapes, RunSettings(1e-3, 0.98), falling=True)


def test_critics_learn_towards_no_more_than_the_highest_value() -> None:
    shapes = Shapes(N_INPUTS, N_ACTIONS, (6,), (64, 48), BATCH)
    goals = assert_learns_as_autograd(shapes, RunSettings(1e-3, 0.98), highest_value=0.5)
    assert 0.1 < float((goals == 0.5).double().mean()) < 0.9


@pytest.mark.parametrize("dense", [False, True], ids=["layered", "dense"])
def test_a_pass_of_fewer_rows_has_the_derivatives_of_autograd(dense: bool) -> None:
    with float64():
        layers, gradients = (new_layers(2, (5, 16, 8, 3), dense=dense) for _ in range(2))
        layers.initialise(slice(0, 2), torch.Generator().manual_seed(0))
        inputs, d_outputs = new_stack(2, 7, 5).normal_(), new_stack(2, 4, 3).normal_()
        network = StackedMlp(layers, 7, n_back_rows=4, dense=dense)
        outputs = network.forward(layers, inputs)
        d_inputs = network.backward(layers, inputs, d_outputs, gradients, 2)
        for i in range(2):
            theirs = mlp(
                [(weight[i], bias[i]) for weight, bias in zip(layers.weights, layers.biases, strict=True)],
                0.0, dense,
            )  # fmt: skip
            read = inputs[i].clone().requires_grad_()
            answers = theirs(read)
            assert_equal_numbers(outputs[i], answers.detach())
            answers[:4].backward(d_outputs[i])
            assert_gradients(gradients.only(i), [theirs])
            if not dense:
                assert d_inputs is not None and read.grad is not None
                assert_equal_numbers(d_inputs[i], read.grad[:4, 2:])


def assert_learns_as_autograd(
    shapes: Shapes, settings: RunSettings, falling: bool = False, highest_value: float = math.inf
) -> Tensor:
    """Check the gradients of twenty updates, and what they lead to; return what the critics learnt towards."""
    generator, goals = torch.Generator().manual_seed(4), []
    with float64():
        fleet = new_fleet(shapes, [0], [settings])
        fleet.highest_value.fill_(highest_value)
        oracle = AutogradSac(fleet, highest_value)
        for n_done in range(20):
            batch, noise = stacked([draw_batch(generator)])
            oracle.rate_share = 1 - falling * n_done / 20
            fleet.at_step(n_done, oracle.rate_share)
            fleet.update(batch, noise)
            goals.append(oracle.update(batch, noise))
            assert_gradients(fleet.critic_gradients, list(oracle.critics))
            if fleet.n_updates >= shapes.actor_delay:
                assert_gradients(fleet.actor.gradients, [oracle.actor])
            if settings.temperature is None and fleet.n_updates >= shapes.actor_delay:
                assert_equal_numbers(fleet._temperature_gradient, oracle.log_temperature.grad)
    learnt = {name: tensor for name, tensor in fleet.tensors(0).items() if "moment" not in name}
    assert_equal_numbers(learnt["log_temperature"], oracle.log_temperature.detach())
    for row in (0, 1):
        assert_equal_numbers(learnt["targets.weight1"][row], linears(oracle.targets[row])[1].weight.detach().T)
    assert_equal_numbers(learnt["actor.weight0"][0], linears(oracle.actor)[0].weight.detach().T)
    return torch.cat(goals)


def assert_gradients(ours: Layers, networks: list[torch.nn.Module]) -> None:
    for row, network in enumerate(networks):
        for weight, bias, linear in zip(ours.weights, ours.biases, linears(network), strict=True):
            assert linear.weight.grad.norm() > 1e-4
            assert_equal_numbers(weight[row], linear.weight.grad.T)
            assert_equal_numbers(bias[row, 0], linear.bias.grad)


def assert_equal_numbers(ours: Tensor, theirs: Tensor) -> None:
    assert ours.dtype == theirs.dtype == torch.float64
    assert float((ours - theirs).abs().max()) <= 1e-10 * float(theirs.abs().max())


def test_fifty_updates_are_those_of_stable_baselines3(monkeypatch: pytest.MonkeyPatch) -> None:
    assert_fifty_updates_are_theirs(monkeypatch, (8, 8))


def assert_fifty_updates_are_theirs(
    monkeypatch: pytest.MonkeyPatch,
    hidden: tuple[int, ...],
    policy: Any = "MlpPolicy",
    of_actor: Callable[[Any], dict[str, Tensor]] = network_parameters,
    actors: Callable[[Sequence[RunSettings]], FleetActors | None] = lambda runs: None,
    at_step: Callable[[SAC, int], None] = lambda model, n_steps: None,
    **own: Any,
) -> None:
    """Compare updates in float64, in which both read the same noise and states."""
    noises: list[Tensor] = []  # of torch's normal distributions
    monkeypatch.setattr("torch.distributions.normal._standard_normal", lambda *_, **__: noises.pop(0))
    monkeypatch.setattr("stable_baselines3.common.policies.preprocess_obs", lambda states, *_, **__: states)
    slope, settings = 0.05, [RunSettings(1e-3, 0.98, 1e-2)]
    own |= {"net_arch": {"pi": list(hidden), "qf": [64, 64]}, "activation_fn": lambda: torch.nn.LeakyReLU(slope)}
    own |= {"optimizer_kwargs": {"weight_decay": settings[0].weight_decay}}
    with float64():
        model = SAC(
            policy, Box11x3(), learning_rate=1e-3, batch_size=BATCH, gamma=0.98, tau=0.01, buffer_size=10, seed=0,
            device="cpu", policy_kwargs=own,
        )  # fmt: skip
        model.learn(0)  # sets the logger up
        shapes = Shapes(N_INPUTS, N_ACTIONS, hidden, (64, 64), BATCH, negative_slope=slope, tau=0.01)
        fleet = new_fleet(shapes, [0], settings, actors(settings))
        start = sb3_parameters(model, of_actor)
        for name, tensor in start.items():
            fleet.tensors(0)[name].copy_(tensor)
        generator = torch.Generator().manual_seed(4)
        for n_done in range(50):
            batch, noise = draw_batch(generator)
            fleet.at_step(200 * n_done)
            fleet.update(*stacked([(batch, noise)]))
            at_step(model, 200 * n_done)
            samples = ReplayBufferSamples(
                batch.states, batch.actions, batch.next_states, 1 - batch.continues[:, None], batch.rewards[:, None]
            )
            model.replay_buffer.sample = lambda *_, samples=samples, **__: samples  # type: ignore[union-attr,method-assign]
            noises.extend([noise[:BATCH], noise[BATCH:]])
            model.train(gradient_steps=1, batch_size=BATCH)
    assert not noises, "Stable-Baselines3 drew less noise than it was given"
    ours = fleet.tensors(0)
    for name, theirs in sb3_parameters(model, of_actor).items():
        moved = float((theirs - start[name]).norm())
        assert moved > 1e-4 or not theirs.numel(), f"{name} did not learn"
        difference = float((ours[name].reshape(theirs.shape) - theirs).norm())
        assert theirs.dtype == ours[name].dtype == torch.float64
        assert difference <= 1e-8 * moved, f"{name}: {difference} after moving by {moved}"


def assert_same(alone: FleetSac, fleet: FleetSac, run: int) -> None:
    for name, tensor in alone.tensors(0).items():
        assert torch.equal(tensor, fleet.tensors(run)[name]), name


@pytest.mark.parametrize(
    ("actor", "critic", "dense"), [((), (64, 64), False), ((6,), (256, 256), True), ((7, 5), (100, 65), True)]
)
def test_a_run_of_a_fleet_is_the_run_alone_bit_for_bit(actor, critic, dense) -> None:  # type: ignore[no-untyped-def]
    shapes = Shapes(N_INPUTS, N_ACTIONS, actor, critic, BATCH, negative_slope=0.05, dense=dense)
    seeds = [0, 1, 2, 3]
    settings = [RunSettings(1e-3, 0.99), RunSettings(3e-4, 0.9, 1e-2), *[RunSettings(1e-3, 0.99)] * 2]
    together, alike = new_fleet(shapes, seeds, settings), new_fleet(shapes, seeds[2:])
    learn(together, seeds, 30)
    learn(alike, seeds[2:], 30)
    states, noise = torch.randn(len(seeds), 1, N_INPUTS), torch.randn(len(seeds), 1, N_ACTIONS)
    actions = together.act(states, noise)
    for run in seeds:
        alone = new_fleet(shapes, [run], [settings[run]])
        learn(alone, [run], 30)
        assert_same(alone, together, run)
        assert torch.equal(alone.act(states[run : run + 1], noise[run : run + 1])[0], actions[run])
    assert_same(alone, alike, 1)


@pytest.mark.parametrize("shape", [(100, 256, 1), (1, 11, 6), (100, 14, 256)], ids=str)
def test_a_product_among_others_is_the_product_alone(shape: tuple[int, int, int]) -> None:
    k, length, m = shape
    left, right, out = (new_stack(3, *sizes) for sizes in ((k, length), (length, m), (k, m)))
    multiply(left.normal_(), right.normal_(), out)
    torch.testing.assert_close(out.double(), left.double() @ right.double(), rtol=1e-3, atol=1e-3)
    for i in range(3):
        alone = multiply(left[i : i + 1], right[i : i + 1], new_stack(1, k, m))
        assert torch.equal(alone[0], out[i])
    assert {network.data_ptr() % 64 for network in out} == {0}  # every network of a stack begins alike
    assert 0 < out.stride(0) - out[0].numel() <= 64 and out[0].is_contiguous()


def test_a_run_stays_itself_in_hundreds_of_updates_also_beside_one_that_diverges() -> None:
    shapes = Shapes(N_INPUTS, N_ACTIONS, (6,), (32, 32), BATCH)
    fleet, alone = new_fleet(shapes, [0, 1]), new_fleet(shapes, [1])
    fleet.tensors(0)["critics.weight1"][0, 0, 0] = float("nan")
    learn(fleet, [0, 1], 300)
    learn(alone, [1], 300)
    assert fleet.tensors(0)["actor.weight0"].isnan().all()
    assert_same(alone, fleet, 1)


def test_acting_is_the_actor_that_stable_baselines3_would_export() -> None:
    fleet = new_fleet(Shapes(N_INPUTS, N_ACTIONS, (8, 4), (16,), BATCH), [0, 1])
    states = torch.randn(2, 5, N_INPUTS)
    x = states[1].double()
    tensors = {name: tensor.double() for name, tensor in fleet.tensors(1).items()}
    for layer in range(3):
        x = x @ tensors[f"actor.weight{layer}"][0] + tensors[f"actor.bias{layer}"][0]
        x = x.relu() if layer < 2 else x
    for answers in (fleet.act(states, None)[1], fleet.answers(1, states[1])):
        torch.testing.assert_close(answers.double(), x[:, :N_ACTIONS].tanh(), rtol=1e-5, atol=1e-6)
    noise = torch.full((2, 5, N_ACTIONS), 2.0)
    noisy = (x[:, :N_ACTIONS] + 2 * x[:, N_ACTIONS:].clamp(-20, 2).exp()).tanh()
    torch.testing.assert_close(fleet.act(states, noise)[1].double(), noisy, rtol=1e-5, atol=1e-6)
