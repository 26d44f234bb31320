import dataclasses
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from sb3_contrib import TRPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import otr
from pipelines.cli.runs import run_config
from pipelines.engine.store import write_files
from pipelines.errors import ConfigError, PipelineError
from pipelines.training.normalisation import input_units, normalised
from pipelines.training.sb3_models import build_model
from pipelines.training.soft_actor import SoftActorCriticPolicy, SoftSacPolicy, SoftSchedule, soft_module
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
    return algorithm(
        SoftActorCriticPolicy,
        make_env(env_id),
        n_steps=N_STEPS,
        batch_size=32,
        policy_kwargs=kwargs,
        seed=0,
        device="cpu",
        **options,
    )


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


@pytest.mark.parametrize("algorithm", [PPO, TRPO])
def test_the_phases_of_pi_prl(algorithm: type) -> None:
    model = make_model(ACTORS[2], algorithm=algorithm)
    module = soft_module(model)
    expected = [{"tests", "maps"}, {"architecture"}, {"tests", "maps"}, {"tests", "maps"}]
    for segment, moving in enumerate(expected):
        before = parameters(model)
        learn_segment(model, "CartPole-v1", segment)
        after = parameters(model)
        prefix = "action_net."
        names = ("tests", "maps", "architecture")
        moved = {name for name in names if not torch.equal(before[prefix + name], after[prefix + name])}
        assert moved == moving
        assert module.is_discrete == (segment == 3)
        assert not torch.equal(before["value_net.weight"], after["value_net.weight"])
    np.testing.assert_array_equal(module.structure, module.architecture[:, 1] > module.architecture[:, 0])


def test_the_phases_of_pi_prl_under_sac(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.training.soft_actor.SAC_TURN", ROLLOUT)
    model = make_model(ACTORS[2], "Pendulum-v1", SAC)
    module = soft_module(model)
    for segment, moving in enumerate([{"tests", "maps"}, {"architecture"}, {"tests", "maps"}, {"tests", "maps"}]):
        before = {name: tensor.clone() for name, tensor in module.named_parameters()}
        learn_segment(model, "Pendulum-v1", segment)
        assert {name for name, tensor in module.named_parameters() if not torch.equal(before[name], tensor)} == moving
        assert module.is_discrete == (segment == 3)
    assert SAC_TURN > 1_000  # a turn of one step would leave Adam's moments of the other's gradients


def test_beta_grows_geometrically_up_to_its_end() -> None:
    model = make_model(ACTORS[1])
    module = soft_module(model)
    for steps, beta in ((0, 1.0), (ROLLOUT, 4.0), (2 * ROLLOUT, 16.0), (3 * ROLLOUT, 16.0)):
        start_rollout(model, steps)
        assert float(module.features.beta) == float(module.decisions.beta) == pytest.approx(beta)
    start_rollout(model, 0, anneal_until=0.0)
    assert float(module.features.beta) == 16.0


def test_the_learning_rate_falls_linearly_over_all_segments() -> None:
    model = make_model(ACTORS[0])
    rates = []
    for segment in range(4):
        learn_segment(model, "CartPole-v1", segment)
        rates.append(model.policy.optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([3e-4, 2.4e-4, 1.8e-4, 1.2e-4])
    start_rollout(model, 5 * ROLLOUT)
    assert model.lr_schedule(1.0) == pytest.approx(0.6e-4)


@pytest.mark.parametrize(
    ("algorithm", "env_id"),
    [(PPO, "CartPole-v1"), (PPO, "Pendulum-v1"), (TRPO, "CartPole-v1"), (TRPO, "Pendulum-v1"), (SAC, "Pendulum-v1")],
)
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
    expected = model.predict(X, deterministic=True)[0]
    np.testing.assert_allclose(tree.predict(X), expected, atol=1e-5)
    np.testing.assert_allclose(SoftPolicy(module, tree.head).predict(X), expected, atol=1e-5)
    assert (tree.labels is not None) == (env_id == "CartPole-v1")


def test_an_answer_does_not_depend_on_the_states_beside_it() -> None:
    torch.manual_seed(0)
    options = {"feature_depth": 3, "n_features": 2, "decision_depth": 3}
    policy = SoftPolicy(build_module(Shape("cdt", options), 8, 2), otr.Identity())
    X = np.random.default_rng(0).normal(size=(100, 8))
    alone = np.concatenate([policy.predict(X[i : i + 1]) for i in range(100)])
    np.testing.assert_allclose(alone, policy.predict(X), rtol=0, atol=1e-13)


def test_axis_aligned_programs_are_refused() -> None:
    space = gym.spaces.Discrete(2)
    assert np.count_nonzero(harden(build_module(ACTORS[0], 4, 2), space, axis_aligned=True).P) == 3
    with pytest.raises(ConfigError, match="oblique"):
        harden(build_module(ACTORS[2], 4, 2), space, axis_aligned=True)
    with pytest.raises(ConfigError, match="only Box and Discrete"):
        harden(build_module(ACTORS[0], 4, 2), gym.spaces.MultiDiscrete([2, 2]))


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
    head = harden(own_units(soft_module(model), units), model.action_space).head
    np.testing.assert_allclose(SoftPolicy(own_units(soft_module(model), units), head).predict(own), expected, atol=1e-5)
    assert np.abs(SoftPolicy(own_units(soft_module(model), None), head).predict(own) - expected).max() > 1e-3


def test_states_are_not_rescaled_and_normalised() -> None:
    with pytest.raises(ConfigError, match=r"algo.normalise=true and actor.rescale_inputs=true"):
        run_config(["env=mountaincar", "method=sdt", "depth=3", "algo.normalise=true"])


def test_noise_by_state_needs_continuous_actions() -> None:
    with pytest.raises(ConfigError, match="use_sde needs continuous actions"):
        build_model(run_config(["env=lunarlander", "method=sdt", "depth=2", "algo.use_sde=true"]), seed=0)


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
