"""Experts as actors of the fleet: what they answer and pay for, the tree that they become, kills, company."""

import numpy as np
import pytest
import torch

import otr
from pipelines.config.stages import ActorConfig, TrainConfig
from pipelines.play.environments import make_env
from pipelines.play.episodes import play_seeds
from pipelines.training.experts_actor import ExpertsActor
from pipelines.training.fleet.trainer import FleetTrainer
from pipelines.training.soft_trees import SoftPolicy, harden, load_soft
from tests.pipelines.training.fleet.test_train import EXPERTS, fleet_run, trained

__all__ = ["fleet_run"]
RESULTS = ("soft.safetensors", "soft.json", "evaluations.csv")


@pytest.fixture
def experts_run(fleet_run):
    return lambda **changes: fleet_run(**{"method": EXPERTS, "depth": 3, **changes})


def test_an_actor_gives_means_and_deviations_and_pays_for_imbalance():
    actor = ExpertsActor(3, 2, 4, 0.5, torch.Generator().manual_seed(0))
    states = torch.randn(10, 3)
    answers = actor(states)
    torch.testing.assert_close(answers[:, :2], actor.mean(states))
    torch.testing.assert_close(answers[:, 2:], actor.log_std(states))
    assert actor.penalty.item() == pytest.approx(0.5 * actor.mean.balance.item())
    again = ExpertsActor(3, 2, 4, 0.5, torch.Generator().manual_seed(0))
    torch.testing.assert_close(again(states), answers, rtol=0, atol=0)


@pytest.mark.parametrize("rescale_inputs", [False, True])
def test_the_tree_does_what_was_trained(experts_run, tmp_path, monkeypatch, rescale_inputs):
    """In states that it visits: the learner answers in its own units, the kept module and tree in the environment's."""
    evaluate, learnt = FleetTrainer.evaluate, []

    def keeping(trainer, r):
        learnt.append(trainer._learner.actor.modules[r])
        return evaluate(trainer, r)

    monkeypatch.setattr(FleetTrainer, "evaluate", keeping)
    config = experts_run(actor=ActorConfig(0.0, rescale_inputs), train=TrainConfig(200, 200, 2, 100))
    (out,) = trained([config], tmp_path)
    module, env = load_soft(out), make_env(config.env)
    tree = harden(module, env.action_space, is_squashed=True)
    assert tree.head == otr.TanhBox([-2.0], [2.0]) and tree.n_leaves == 4
    states = play_seeds(tree.predict, config.env, [5, 6], keep_states=True, n_workers=1).states
    clear = np.abs(states @ tree.P.T + tree.v).min(axis=1) > 1e-4  # of the tests' values, beside float32
    assert clear.mean() > 0.9
    states, expected = states[clear], tree.predict(states[clear])
    np.testing.assert_allclose(SoftPolicy(module, tree.head).predict(states), expected, atol=1e-9)
    seen = states / [1, 1, 8] if rescale_inputs else states
    with torch.no_grad():
        (actor,) = learnt
        answers = 2 * torch.tanh(actor.mean(torch.as_tensor(seen, dtype=torch.float32)))
    np.testing.assert_allclose(answers, expected, atol=1e-5)
