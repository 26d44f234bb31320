import dataclasses
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from pipelines.cli.runs import run_config
from pipelines.engine.store import write_files
from pipelines.errors import ConfigError, PipelineError
from pipelines.training.sb3.models import build_model
from pipelines.training.sb3.normalisation import input_units, normalised
from pipelines.training.sb3.soft_actor import SoftActorCriticPolicy, SoftSacPolicy, SoftSchedule, soft_module
from pipelines.training.soft_trees import (
    SAC_TURN,
    Shape,
    SoftPolicy,
    build_module,
    harden,
    load_soft,
    own_units,
    soft_files,
)
from tests.control.test_soft_tree import clear_states
from tests.pipelines.conftest import PI_PRL

torch.set_num_threads(1)

ACTORS = [
    Shape("sdt", {"depth": 2, "affine_leaves": False}),
    Shape("cdt", {"feature_depth": 1, "n_features": 2, "decision_depth": 2}),
    Shape("pi_prl", {"depth": 2, "structure_penalty": 0.25}),
]
N_STEPS, N_ENVS = 32, 2
ROLLOUT = N_STEPS * N_ENVS

ids = pytest.mark.parametrize("actor", ACTORS, ids=lambda actor: actor.kind)


def make_env(env_id: str, n_envs: int = N_ENVS) -> DummyVecEnv:
    return DummyVecEnv([lambda: Monitor(gym.make(env_id))] * n_envs)


def make_model(actor: Shape, env_id: str = "CartPole-v1", algorithm: type = PPO, **options: Any) -> BaseAlgorithm:
    if algorithm is SAC:
        kwargs = {"actor": actor, "net_arch": {"pi": [], "qf": [8]}}
        options = {"buffer_size": 1_000, "learning_starts": 20, "batch_size": 32, **options}
        return SAC(SoftSacPolicy, make_env(env_id, 1), policy_kwargs=kwargs, seed=0, device="cpu", **options)
    kwargs = {"actor": actor, "net_arch": {"pi": [], "vf": [8]}}
    options = {"n_steps": N_STEPS, "batch_size": 32, "policy_kwargs": kwargs, "seed": 0, "device": "cpu", **options}
    return algorithm(SoftActorCriticPolicy, make_env(env_id), **options)


def learn_segment(model: BaseAlgorithm, env_id: str, segment: int, n_rollouts: int = 1) -> None:
    """Train as the stage train does: new environments and a seed for each segment."""
    model.set_logger(Logger(folder=None, output_formats=[]))
    model.set_env(make_env(env_id, model.n_envs), force_reset=True)
    model.set_random_seed(segment)
    model.learn(n_rollouts * ROLLOUT, SoftSchedule(PI_PRL, 4 * ROLLOUT), log_interval=None, reset_num_timesteps=False)


def start_rollout(model: BaseAlgorithm, n_steps_done: int, **changes: float) -> None:
    schedule = SoftSchedule(dataclasses.replace(PI_PRL, **changes), 4 * ROLLOUT)
    schedule.init_callback(model)
    model.num_timesteps = n_steps_done
    schedule.on_rollout_start()


def parameters(model: BaseAlgorithm) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_the_phases_of_pi_prl(algorithm: type, monkeypatch: pytest.MonkeyPatch) -> None:
    env_id = "Pendulum-v1" if algorithm is SAC else "CartPole-v1"
    assert SAC_TURN > 1_000  # a turn of one step would leave Adam's moments of the other's gradients
    monkeypatch.setattr("pipelines.training.sb3.soft_actor.SAC_TURN", ROLLOUT)
    model = make_model(ACTORS[2], env_id, algorithm)
    module, rates = soft_module(model), []
    for segment, moving in enumerate([{"tests", "maps"}, {"architecture"}, {"tests", "maps"}, {"tests", "maps"}]):
        before, others = {name: tensor.clone() for name, tensor in module.named_parameters()}, parameters(model)
        learn_segment(model, env_id, segment)
        assert {name for name, tensor in module.named_parameters() if not torch.equal(before[name], tensor)} == moving
        assert module.is_discrete == (segment == 3)
        if algorithm is not SAC:
            assert not torch.equal(others["value_net.weight"], model.policy.value_net.weight)
            rates.append(model.policy.optimizer.param_groups[0]["lr"])
    np.testing.assert_array_equal(module.structure, module.architecture[:, 1] > module.architecture[:, 0])
    if algorithm is PPO:  # the learning rate falls linearly over all segments
        assert rates == pytest.approx([3e-4, 2.4e-4, 1.8e-4, 1.2e-4])
        start_rollout(model, 5 * ROLLOUT)
        assert model.lr_schedule(1.0) == pytest.approx(0.6e-4)


def test_beta_grows_geometrically_up_to_its_end() -> None:
    model = make_model(ACTORS[1])
    module = soft_module(model)
    for steps, beta in ((0, 1.0), (ROLLOUT, 4.0), (2 * ROLLOUT, 16.0), (3 * ROLLOUT, 16.0)):
        start_rollout(model, steps)
        assert float(module.features.beta) == float(module.decisions.beta) == pytest.approx(beta)
    start_rollout(model, 0, anneal_until=0.0)
    assert float(module.features.beta) == 16.0


OF_ENV = [(PPO, "CartPole-v1"), (PPO, "Pendulum-v1"), (SAC, "Pendulum-v1")]


@pytest.mark.parametrize(("algorithm", "env_id"), OF_ENV)
@ids
def test_the_hard_tree_is_the_policy_of_hard_tests(actor: Shape, algorithm: type, env_id: str) -> None:
    model = make_model(actor, env_id, algorithm)
    learn_segment(model, env_id, 0)
    module = soft_module(model)
    module.set_beta(1e6)
    if actor.kind == "pi_prl":
        module.discretise()
    tree = harden(module, model.action_space, is_squashed=algorithm is SAC)
    X = clear_states(tree, 100, margin=1e-4).astype(np.float32)
    assert len(X) > 50
    policy, expected = SoftPolicy(module, tree.head), model.predict(X, deterministic=True)[0]
    np.testing.assert_allclose(tree.predict(X), expected, atol=1e-5)
    np.testing.assert_allclose(policy.predict(X), expected, atol=1e-5)
    assert (tree.labels is not None) == (env_id == "CartPole-v1")
    alone = np.concatenate([policy.predict(X[i : i + 1]) for i in range(len(X))])  # no matter which states are beside
    np.testing.assert_allclose(alone, policy.predict(X), rtol=0, atol=1e-13)


def test_what_has_no_meaning_is_refused() -> None:
    space = gym.spaces.Discrete(2)
    assert np.count_nonzero(harden(build_module(ACTORS[0], 4, 2), space, axis_aligned=True).P) == 3
    words = ["env=mountaincar", "method=sdt", "depth=3", "algo.normalise=true"]
    noisy = ["env=lunarlander", "method=sdt", "depth=2", "algo.use_sde=true"]
    for ask, message in (
        (lambda: harden(build_module(ACTORS[2], 4, 2), space, axis_aligned=True), "oblique"),
        (lambda: harden(build_module(ACTORS[0], 4, 2), gym.spaces.MultiDiscrete([2, 2])), "only Box and Discrete"),
        (lambda: run_config(words), r"algo.normalise=true and actor.rescale_inputs=true"),
        (lambda: build_model(run_config(noisy), seed=0), "use_sde needs continuous actions"),
    ):
        with pytest.raises(ConfigError, match=message):
            ask()


@ids
def test_modules_trained_on_rescaled_states_read_the_environments_own(actor: Shape) -> None:
    config = run_config(["env=mountaincar", "method=sdt", "depth=3"])
    assert config.actor.rescale_inputs
    model = make_model(actor, "MountainCarContinuous-v0", use_sde=True)
    learn_segment(model, "MountainCarContinuous-v0", 0)
    low, high = model.observation_space.low, model.observation_space.high
    own = np.random.default_rng(0).uniform(low, high, (50, 2)).astype(np.float32)
    rescaled = (own - (low + high) / 2) / ((high - low) / 2)
    expected = model.predict(rescaled, deterministic=True)[0]
    exported = own_units(soft_module(model), input_units(model, config))
    head = harden(exported, model.action_space).head
    np.testing.assert_allclose(SoftPolicy(exported, head).predict(own), expected, atol=1e-4)
    as_is = SoftPolicy(own_units(soft_module(model), None), head).predict(rescaled)
    np.testing.assert_allclose(as_is, expected, atol=1e-6)  # of float32


@ids
def test_modules_trained_on_normalised_states_read_the_environments_own(actor: Shape) -> None:
    config = run_config(["env=pendulum", "method=sdt", "depth=2", "algo.normalise=true"])
    model = make_model(actor, "Pendulum-v1")
    model.set_env(normalised(make_env("Pendulum-v1"), config), force_reset=True)
    model.learn(4 * ROLLOUT)
    statistics = model.get_vec_normalize_env().obs_rms
    own = np.random.default_rng(0).uniform([-1, -1, -8], [1, 1, 8], (50, 3)).astype(np.float32)
    seen = (own - statistics.mean) / np.sqrt(statistics.var)
    expected = model.predict(seen, deterministic=True)[0]
    units = input_units(model, config)
    module = own_units(soft_module(model), units)
    head = harden(module, model.action_space).head
    np.testing.assert_allclose(SoftPolicy(module, head).predict(own), expected, atol=1e-5)
    assert np.abs(SoftPolicy(own_units(soft_module(model), None), head).predict(own) - expected).max() > 1e-3


@ids
def test_modules_survive_a_round_trip(tmp_path: Path, actor: Shape) -> None:
    module = build_module(actor, 4, 3)
    module.set_beta(7.0)
    if actor.kind == "pi_prl":
        module.discretise()
    write_files(soft_files(module, actor), tmp_path)
    again = load_soft(tmp_path)
    assert type(again) is type(module)
    for name, tensor in module.state_dict().items():
        assert torch.equal(again.state_dict()[name], tensor), name
    whole = (tmp_path / "soft.safetensors").read_bytes()
    (tmp_path / "soft.safetensors").write_bytes(whole[:-5])
    with pytest.raises(PipelineError, match=r"soft\.safetensors"):
        load_soft(tmp_path)
