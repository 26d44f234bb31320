"""Every kind of policy on a vector that Stable-Baselines3 and sb3-contrib have is read as what it predicts."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import FlattenObservation
from sb3_contrib import ARS, QRDQN, TQC, TRPO, CrossQ, MaskablePPO
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3

import otr
from otr.importers.critics import critics_of_zip
from tests.importers.test_critics import values
from tests.importers.test_importers import FourActions, WideBox
from tests.importers.test_sb3_archive import changed

torch.set_num_threads(1)
RELU = {"activation_fn": torch.nn.ReLU, "net_arch": [8, 5]}
LAYERS = {"net_arch": [8, 5]}
PENDULUM, CART = "Pendulum-v1", "CartPole-v1"
KINDS = {
    "PPO with gSDE": (PPO, PENDULUM, RELU, {"use_sde": True}),
    "PPO with gSDE, squashed": (PPO, PENDULUM, RELU | {"squash_output": True}, {"use_sde": True}),
    "SAC with gSDE": (SAC, PENDULUM, LAYERS, {"use_sde": True}),
    "SAC with gSDE, unlimited": (SAC, PENDULUM, LAYERS | {"clip_mean": 0.0}, {"use_sde": True}),
    "TQC": (TQC, PENDULUM, LAYERS, {}),
    "TQC with gSDE": (TQC, PENDULUM, LAYERS | {"clip_mean": 0.5}, {"use_sde": True}),
    "TRPO": (TRPO, CART, RELU, {}),
    "CrossQ": (CrossQ, PENDULUM, LAYERS, {}),
    "QR-DQN": (QRDQN, CART, LAYERS | {"n_quantiles": 7}, {}),
    "ARS": (ARS, PENDULUM, LAYERS, {}),
    "ARS, clipped": (ARS, PENDULUM, LAYERS | {"squash_output": False}, {}),
    "ARS of labels": (ARS, CART, LAYERS, {}),
    "ARS without layers": (ARS, PENDULUM, {"net_arch": []}, {}),
    **{
        f"{algorithm.__name__}, {n} layers": (algorithm, env, {**RELU, "net_arch": [6, 5][:n]}, {})
        for algorithm, env in (
            *((kind, WideBox()) for kind in (PPO, A2C, TRPO, SAC, TD3, DDPG)),
            (A2C, FourActions()),
            (DQN, FourActions()),
        )
        for n in range(3)
    },
}  # fmt: skip


def drawn(algorithm, env, policy_kwargs, **settings):
    """Return a model with numbers so large that every limit and every unit comes into play."""
    buffer = {} if algorithm in (PPO, A2C, ARS, TRPO, MaskablePPO) else {"buffer_size": 10}
    policy = dict(policy_kwargs)
    model = algorithm("MlpPolicy", env, policy_kwargs=policy, seed=0, device="cpu", **buffer, **settings)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, tensor in model.policy.state_dict().items():
            if tensor.is_floating_point():
                tensor.normal_(generator=generator)
                if name.endswith("ra_var"):
                    tensor.abs_()
    return model


def assert_same(model, network):
    X = np.random.default_rng(0).normal(size=(300, network.n_inputs)).astype(np.float32)
    if isinstance(model, DQN):
        values = model.q_net(torch.from_numpy(X)).detach().numpy()
        np.testing.assert_allclose(network.forward(X), values, atol=1e-4)
    acted, _ = model.predict(X, deterministic=True)
    found = network.predict(X)
    np.testing.assert_allclose(found.reshape(acted.shape), acted, atol=2e-5)
    assert len(np.unique(acted)) > 1


@pytest.mark.parametrize("kind", KINDS)
def test_a_policy_is_what_it_predicts(kind, tmp_path):
    algorithm, env, policy_kwargs, settings = KINDS[kind]
    model = drawn(algorithm, env, policy_kwargs, **settings)
    model.save(tmp_path / "policy")
    for network in (otr.from_sb3(tmp_path / "policy"), otr.from_sb3(model)):
        assert_same(model, network)
        assert network.hidden_widths[: len(policy_kwargs["net_arch"])] == tuple(policy_kwargs["net_arch"])
        tree = otr.map_network(network) if network.n_hidden < 14 else None
        if tree is not None:
            X = np.random.default_rng(1).normal(size=(50, network.n_inputs))
            np.testing.assert_allclose(tree.predict(X), network.predict(X), atol=1e-9)


def test_the_names_of_sb3_contrib_1_3_are_read(tmp_path):
    model = ARS("LinearPolicy", CART, zero_policy=False, seed=0, device="cpu")
    model.policy.action_net[0].weight.data.normal_()
    model.save(tmp_path / "new.zip")
    old_names = lambda tensors: {name.replace("_net.0.", "_net."): tensor for name, tensor in tensors.items()}  # noqa: E731
    changed(tmp_path / "new.zip", tmp_path / "old.zip", old_names)
    assert_same(model, otr.from_sb3(tmp_path / "old.zip"))


class Masked(FlattenObservation):
    """CartPole, whose actions are all allowed."""

    def action_masks(self):
        return np.ones(2, dtype=bool)


def test_masks_are_left_out_and_that_is_said(tmp_path):
    model = drawn(MaskablePPO, Masked(gym.make(CART)), RELU)
    model.save(tmp_path / "policy")
    with pytest.warns(UserWarning, match="trained with action masks; it is read without"):
        network = otr.from_sb3(tmp_path / "policy")
    assert_same(model, network)


def test_a_quantile_critic_is_read_as_its_mean_and_a_normalised_one_is_not(tmp_path):
    model = drawn(TQC, PENDULUM, LAYERS)
    model.save(tmp_path / "tqc.zip")
    X, actions = torch.randn(20, 3), torch.rand(20, 1) * 2 - 1
    with torch.no_grad():
        wanted = model.critic(X, actions).mean(dim=2).T  # (2, 20), of the quantiles
    found = values(critics_of_zip(tmp_path / "tqc.zip").layers, X.numpy(), actions.numpy())
    np.testing.assert_allclose(found, wanted.numpy(), rtol=1e-4, atol=1e-4)
    drawn(CrossQ, PENDULUM, LAYERS).save(tmp_path / "crossq.zip")
    assert critics_of_zip(tmp_path / "crossq.zip") is None


def test_other_policies_say_what_can_be_read(tmp_path):
    drawn(PPO, PENDULUM, RELU).save(tmp_path / "policy.zip")
    recurrent = {"lstm_actor.weight_ih_l0": torch.zeros(2, 2)}
    changed(tmp_path / "policy.zip", tmp_path / "other.zip", lambda tensors: tensors | recurrent)
    with pytest.raises(otr.InvalidNetworkError, match=r"the tensor 'lstm_actor.*; only 'MlpPolicy' of"):
        otr.from_sb3(tmp_path / "other.zip")


def test_labels_that_tie_in_the_probabilities_of_a_live_model_are_the_same() -> None:
    model = PPO("MlpPolicy", CART, policy_kwargs=RELU, seed=0, device="cpu")
    with torch.no_grad():
        model.policy.action_net.weight.mul_(1e-6)
    assert otr.from_sb3(model).head == otr.Argmax()


PARTS = gym.spaces.Dict({"speed": gym.spaces.Box(-9, 9, (2,)), "at": gym.spaces.Discrete(3)})


@pytest.mark.parametrize(
    "seen",
    [PARTS, gym.spaces.Discrete(5), gym.spaces.MultiBinary(4), gym.spaces.MultiDiscrete([2, 3])],
    ids=["dict", "discrete", "binary", "several"],
)
@pytest.mark.parametrize("start", [0, 3])
def test_observations_that_are_flattened(tmp_path: Path, seen: gym.Space, start: int) -> None:
    """The network reads what FlattenObservation makes of them; labels count from 0."""

    class Seen(FourActions):
        observation_space = seen
        action_space = gym.spaces.Discrete(4, start=start)

        def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
            return self.observation_space.sample(), {}

    policy = "MultiInputPolicy" if seen is PARTS else "MlpPolicy"
    relu = {"net_arch": [6], "activation_fn": torch.nn.ReLU}
    model = PPO(policy, Seen(), policy_kwargs=relu, seed=0, device="cpu", n_steps=8)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.normal_()
    model.save(tmp_path / "model.zip")
    seen.seed(1)
    samples = [seen.sample() for _ in range(40)]
    flat = np.stack([gym.spaces.flatten(seen, each) for each in samples])
    expected = [int(model.predict(each, deterministic=True)[0]) for each in samples]
    for given in (model, tmp_path / "model.zip"):
        assert otr.from_sb3(given).predict(flat).tolist() == expected
