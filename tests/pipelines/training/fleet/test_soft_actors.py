"""Soft trees as actors of the batched soft actor-critic: Stable-Baselines3's numbers, and every run on its own."""

import dataclasses
from typing import Any

import pytest
import torch
from stable_baselines3 import SAC
from torch import Tensor

from otr.control.sac.adam import RunSettings
from otr.control.sac.sac import FleetSac, Shapes
from pipelines.training.fleet.soft_actors import SoftActors, SoftTraining
from pipelines.training.sb3.soft_actor import SoftSacPolicy, soft_module
from pipelines.training.soft_trees import Shape, rate_share, set_phase
from tests.control.sac.test_sac import (
    BATCH,
    N_ACTIONS,
    N_INPUTS,
    assert_fifty_updates_are_theirs,
    assert_same,
    learn,
    new_fleet,
)
from tests.pipelines.conftest import PI_PRL

# 50 updates, 200 steps after each: two turns of the program, two of the architecture, the structure chosen
KINDS = {
    "pi_prl": {"depth": 2, "structure_penalty": 0.25},
    "pi_prl deeper": {"depth": 4, "structure_penalty": -0.5},
    "pi_prl without tests": {"depth": 0},
    "sdt": {"depth": 3, "affine_leaves": False},
    "sdt with affine leaves": {"depth": 3, "affine_leaves": True},
    "cdt": {"feature_depth": 2, "n_features": 4, "decision_depth": 2},
}
SOFT = {kind: SoftTraining(Shape(kind.split()[0], options), PI_PRL, 10_000) for kind, options in KINDS.items()}
# The structure is chosen in a turn of the program and not of the architecture.
SOFT["pi_prl deeper"] = dataclasses.replace(SOFT["pi_prl deeper"], n_steps=6_400)
SETTINGS = RunSettings(1e-3, 0.99)


def trees_of(training: SoftTraining, runs: Any) -> SoftActors:
    return SoftActors(runs, training, N_INPUTS, N_ACTIONS, BATCH)


def parameters_of(actor: Any) -> dict[str, Tensor]:
    parts = {"mean": actor.mu, "log_std": actor.log_std}
    return {f"actor.{part}.{name}": tensor for part, head in parts.items() for name, tensor in head.named_parameters()}


@pytest.mark.parametrize("kind", SOFT)
def test_fifty_updates_are_those_of_stable_baselines3(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    soft = SOFT[kind]

    def at_step(model: SAC, n_steps: int) -> None:
        set_phase(soft_module(model), soft.method, n_steps, soft.n_steps)
        share = rate_share(soft.method, n_steps, soft.n_steps)
        model.lr_schedule = lambda _: 1e-3 * share  # type: ignore[method-assign]

    assert_fifty_updates_are_theirs(
        monkeypatch, (), SoftSacPolicy, parameters_of, lambda runs: trees_of(soft, runs), at_step, actor=soft.shape
    )


@pytest.mark.parametrize("kind", SOFT)
def test_a_run_of_soft_trees_is_the_run_alone_and_goes_on_from_what_it_had_learnt(kind: str) -> None:
    shapes = Shapes(N_INPUTS, N_ACTIONS, (), (64, 64), BATCH)
    together, alone = (
        new_fleet(shapes, seeds, actor=trees_of(SOFT[kind], [SETTINGS] * len(seeds))) for seeds in ([0, 1], [1])
    )
    learn(together, [0, 1], 45)
    learn(alone, [1], 45)
    assert_same(alone, together, 1)
    states, noise = torch.randn(2, 1, N_INPUTS), torch.randn(2, 1, N_ACTIONS)
    assert torch.equal(alone.act(states[1:], noise[1:])[0], together.act(states, noise)[1])
    steps = {name: int(tensor) for name, tensor in alone.tensors(0).items() if name.endswith(".step")}
    assert steps["actor.log_std.weight.step"] == 45
    if kind == "pi_prl":
        assert alone.tensors(0)["actor.mean.structure"].min() >= 0
        assert 0 < steps["actor.mean.architecture.step"] < steps["actor.mean.tests.step"] < 45
    again = FleetSac(shapes, alone.runs, alone.n_updates, trees_of(SOFT[kind], alone.runs))
    again.load(0, {name: tensor.clone() for name, tensor in alone.tensors(0).items()})
    for fleet in (alone, again):
        learn(fleet, [7], 10)
    assert_same(again, alone, 0)
