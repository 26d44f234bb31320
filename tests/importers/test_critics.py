"""Critics of Stable-Baselines3's zips: the values that its own networks give, targets, temperature, discount."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from otr.errors import InvalidNetworkError
from otr.importers.critics import Critics, critics_of_zip, read_critics

torch.set_num_threads(1)


def values(layers: Any, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Return the values (n_critics, n) of actions in [-1, 1]."""
    read: Any = np.column_stack((states, actions))[None]
    for i, (weight, bias) in enumerate(layers):
        read = (np.maximum(read, 0) if i else read) @ weight + bias
    return np.asarray(read[..., 0])


def saved(algorithm: Any, folder: Path, **kwargs: Any) -> tuple[Any, Critics]:
    """Return a model whose targets differ from its critics, and the critics in its zip."""
    policy = {"net_arch": {"pi": [4], "qf": [8, 8]}}
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=policy, gamma=0.9, seed=0, **kwargs)
    with torch.no_grad():
        for parameter in model.critic_target.parameters():
            parameter.mul_(0.5)
    model.save(folder / "model")
    found = critics_of_zip(folder / "model")
    assert found is not None
    return model, found


@pytest.mark.parametrize("algorithm", [SAC, TD3, DDPG])
def test_values_are_those_of_stable_baselines3(algorithm: Any, tmp_path: Path) -> None:
    model, critics = saved(algorithm, tmp_path)
    generator = np.random.default_rng(0)
    states, actions = generator.normal(size=(20, 3)), generator.uniform(-1, 1, (20, 1))
    tensors = (torch.from_numpy(states).float(), torch.from_numpy(actions).float())
    with torch.no_grad():
        for layers, theirs in ((critics.layers, model.critic), (critics.targets, model.critic_target)):
            expected = torch.stack(theirs(*tensors))[..., 0].numpy()
            np.testing.assert_allclose(values(layers, states, actions), expected, atol=1e-5)
    assert (critics.gamma, critics.negative_slope, critics.widths) == (0.9, 0.0, (8, 8))
    assert len(critics.layers[0][0]) == (1 if algorithm is DDPG else 2)
    assert (critics.log_temperature is None) == (critics.log_std is None) == (algorithm is not SAC)


@pytest.mark.parametrize("ent_coef, expected", [("auto_0.5", 0.5), (0.25, 0.25)])
def test_a_temperature_is_read_learnt_or_fixed(ent_coef: Any, expected: float, tmp_path: Path) -> None:
    model, critics = saved(SAC, tmp_path, ent_coef=ent_coef)
    assert critics.log_temperature is not None and np.exp(critics.log_temperature) == pytest.approx(expected)
    with torch.no_grad():
        states = torch.randn(5, 3)
        _, log_std, _ = model.actor.get_action_dist_params(states)
        neurons = model.actor.latent_pi(states).numpy()
    assert critics.log_std is not None
    np.testing.assert_allclose(neurons @ critics.log_std[:, :-1].T + critics.log_std[:, -1], log_std, atol=1e-6)


def test_states_in_other_units_have_the_same_values(tmp_path: Path) -> None:
    _, critics = saved(SAC, tmp_path)
    generator = np.random.default_rng(0)
    states, actions = generator.normal(size=(20, 3)), generator.uniform(-1, 1, (20, 1))
    middle, scale = np.array([1.0, -2.0, 0.5]), np.array([0.5, 2.0, 8.0])
    folded = critics.fold_input_normalisation(middle, scale)
    for ours, theirs in ((folded.layers, critics.layers), (folded.targets, critics.targets)):
        expected = values(theirs, states, actions)
        np.testing.assert_allclose(values(ours, states * scale + middle, actions), expected, atol=1e-9)


def test_what_has_no_critics_of_relu_units_has_none(tmp_path: Path) -> None:
    PPO("MlpPolicy", gym.make("Pendulum-v1"), seed=0).save(tmp_path / "ppo")
    smooth = {"net_arch": [4], "activation_fn": torch.nn.Tanh}
    SAC("MlpPolicy", "Pendulum-v1", policy_kwargs=smooth, seed=0).save(tmp_path / "smooth")
    assert critics_of_zip(tmp_path / "ppo.zip") is critics_of_zip(tmp_path / "smooth.zip") is None
    with pytest.raises(InvalidNetworkError, match=r"ppo\.zip has no critics of \(leaky\) ReLU units"):
        read_critics(tmp_path / "ppo.zip")


def test_critics_of_normalised_states_are_refused(tmp_path: Path) -> None:
    normalised = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    model = SAC("MlpPolicy", normalised, policy_kwargs={"net_arch": [4]}, seed=0)
    model.save(tmp_path / "model")
    assert read_critics(tmp_path / "model.zip").widths == read_critics(str(tmp_path / "model")).widths == (4,)
    normalised.save(str(tmp_path / "vecnormalize.pkl"))
    with pytest.raises(InvalidNetworkError, match="judge states and rewards as VecNormalize made them"):
        read_critics(tmp_path / "model.zip")
