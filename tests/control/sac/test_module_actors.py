"""Actors that are modules: what the hand-written networks do, and every run on its own."""

import torch
from torch import Tensor, nn

from otr.control.sac.actors import ModuleActors
from otr.control.sac.adam import RunSettings
from otr.control.sac.sac import FleetSac, Shapes
from tests.control.sac.autograd_sac import mlp
from tests.control.sac.test_sac import N_ACTIONS, N_INPUTS, float64, learn, new_fleet

SETTINGS = [RunSettings(1e-3, 0.99), RunSettings(1e-3, 0.97), RunSettings(3e-3, 0.9, 1e-4)]


def actor_of(tensors: dict[str, Tensor]) -> nn.Module:
    return mlp([(tensors[f"actor.weight{i}"][0], tensors[f"actor.bias{i}"][0]) for i in range(2)], 0.0)


def module_fleet(by_hand: FleetSac, runs: list[int]) -> FleetSac:
    """Return a fleet of the same critics, whose actors are modules with the same numbers."""
    settings = [by_hand.runs[run] for run in runs]
    modules = [actor_of(by_hand.tensors(run)) for run in runs]
    fleet = FleetSac(by_hand.shapes, settings, actor=ModuleActors(settings, modules))
    for place, run in enumerate(runs):
        theirs = by_hand.tensors(run)
        for name, tensor in fleet.tensors(place).items():
            if not name.startswith("actor."):
                tensor.copy_(theirs[name])
    return fleet


def test_modules_learn_as_networks_by_hand() -> None:
    with float64():
        by_hand = new_fleet(Shapes(N_INPUTS, N_ACTIONS, (6,), (16, 16), 100), [0, 1, 2], SETTINGS)
        modules = module_fleet(by_hand, [0, 1, 2])
        states = torch.randn(3, 5, N_INPUTS)
        torch.testing.assert_close(modules.act(states, None), by_hand.act(states, None))
        for fleet in (by_hand, modules):
            learn(fleet, [0, 1, 2], 20)
        for run in range(3):
            ours, theirs = modules.tensors(run), by_hand.tensors(run)
            for i in range(2):
                found = ours[f"actor.{2 * i}.weight"].T
                torch.testing.assert_close(found, theirs[f"actor.weight{i}"][0], rtol=1e-9, atol=1e-11)
                found = ours[f"actor.{2 * i}.bias"]
                torch.testing.assert_close(found, theirs[f"actor.bias{i}"][0, 0], rtol=1e-9, atol=1e-11)
            torch.testing.assert_close(ours["critics.weight1"], theirs["critics.weight1"], rtol=1e-9, atol=1e-11)
            torch.testing.assert_close(modules.answers(run, states[run]), by_hand.answers(run, states[run]))


class Penalised(nn.Linear):
    """A linear actor whose loss has the sum of its squared weights besides."""

    def forward(self, states: Tensor) -> Tensor:
        self.penalty = 0.3 * self.weight.square().sum()
        return super().forward(states)


def test_a_module_s_penalty_is_part_of_its_loss() -> None:
    with float64():
        modules = [Penalised(N_INPUTS, 2 * N_ACTIONS) for _ in range(2)]
        actors = ModuleActors(SETTINGS[:2], modules)
        inputs, d_answers = torch.randn(2, 8, N_INPUTS), torch.randn(2, 4, 2 * N_ACTIONS)
        actors.forward(inputs)
        actors.backward(inputs, d_answers)
        for module, states, derivative in zip(modules, inputs, d_answers, strict=True):
            assert module.weight.grad is not None and module.bias.grad is not None
            torch.testing.assert_close(module.weight.grad, derivative.T @ states[:4] + 0.6 * module.weight.detach())
            torch.testing.assert_close(module.bias.grad, derivative.sum(0))
