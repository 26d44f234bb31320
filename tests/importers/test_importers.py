import io
import json
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import DDPG, PPO, SAC, TD3
from torch import nn

import otr
from otr.importers import read_policy

torch.set_num_threads(1)


@pytest.mark.parametrize("package", [otr, otr.control, otr.importers, otr.learners])
def test_a_package_lists_its_public_names(package: object) -> None:
    listed = {name for name in dir(package) if not name.startswith("__")}
    assert listed == {*package.__all__} | ({"control", "importers", "learners"} if package is otr else set())


class FourActions(gym.Env):
    """Four discrete actions, three inputs."""

    observation_space = gym.spaces.Box(-1, 1, (3,))
    action_space = gym.spaces.Discrete(4)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        return np.zeros(3, np.float32), {}

    def step(self, action: int) -> tuple:
        return np.zeros(3, np.float32), 0.0, True, False, {}


class WideBox(FourActions):
    """Three continuous actions in an uneven box."""

    action_space = gym.spaces.Box(np.float32([-0.4, -1, 0.1]), np.float32([0.4, 2, 1 / 3]))


class TwoDiscrete(FourActions):
    action_space = gym.spaces.MultiDiscrete([2, 3])


class Image(FourActions):
    observation_space = gym.spaces.Box(0, 255, (36, 36, 3), np.uint8)


def build(
    algorithm: type, env: object, critic: dict, widths: list[int], activation: object = nn.ReLU, **options: object
):
    kwargs = {"net_arch": {"pi": widths, **critic}, "activation_fn": activation, **options.pop("policy_kwargs", {})}
    if algorithm in (SAC, TD3, DDPG):
        options.setdefault("buffer_size", 10)
    return algorithm("MlpPolicy", env, policy_kwargs=kwargs, seed=0, device="cpu", **options)


def assert_predicts_as(model: object, network: otr.ReluNetwork, *, scale: float = 3.0) -> None:
    X = (np.random.default_rng(0).normal(size=(200, network.n_inputs)) * scale).astype(np.float32)
    answers, expected = network.predict(X), model.predict(X, deterministic=True)[0]
    if answers.dtype.kind == "i":
        np.testing.assert_array_equal(answers, expected)
    else:
        np.testing.assert_allclose(answers, expected.reshape(answers.shape), atol=1e-6)


def test_leaky_relu(tmp_path: Path) -> None:
    model = build(SAC, "Pendulum-v1", {"qf": [8]}, [6, 5], nn.LeakyReLU)
    model.save(tmp_path / "model")
    for given in (model, tmp_path / "model"):
        network = otr.from_sb3(given)
        assert network.negative_slope == 0.01
        assert_predicts_as(model, network)
        with pytest.raises(otr.InvalidNetworkError, match=r"negative_slope is 0\.2"):
            otr.from_sb3(given, negative_slope=0.2)


def test_action_limits_can_be_given(tmp_path: Path) -> None:
    model = build(SAC, "Pendulum-v1", {"qf": [8]}, [3])
    model.save(tmp_path / "model")
    for source in (model, tmp_path / "model"):
        assert otr.from_sb3(source, action_low=[-5.0], action_high=[5.0]).head == otr.TanhBox([-5.0], [5.0])


def test_policies_that_are_no_relu_network_are_refused(tmp_path: Path) -> None:
    pi, qf = {"vf": [8]}, {"qf": [8]}
    refused = [
        (build(PPO, "Pendulum-v1", pi, [4], nn.Tanh), "activation_fn=torch.nn.ReLU"),
        (PPO("MlpPolicy", "Pendulum-v1", device="cpu"), "activation_fn=torch.nn.ReLU"),
        (build(SAC, "Pendulum-v1", qf, [4], nn.ELU), "Linear, ReLU and LeakyReLU|activation_fn=torch.nn.ReLU"),
        (build(SAC, "Pendulum-v1", qf, [4], nn.LeakyReLU, use_sde=True), "gSDE clips the mean of the actions at 2"),
        (build(PPO, TwoDiscrete(), pi, [4]), "only Box and Discrete can be mapped: train with one label"),
        (PPO("CnnPolicy", Image(), device="cpu"), "CnnPolicy|feature extractor"),
    ]
    for model, message in refused:
        with pytest.raises(otr.InvalidNetworkError, match=message):
            otr.from_sb3(model)
        model.save(tmp_path / "model")
        with pytest.raises(otr.InvalidNetworkError, match=message):
            otr.from_sb3(tmp_path / "model")


def test_things_that_are_no_model_are_refused(tmp_path: Path) -> None:
    with pytest.raises(otr.InvalidNetworkError, match="got int"):
        otr.from_sb3(3)
    with pytest.raises(otr.ArtefactError, match="does not exist"):
        otr.from_sb3(tmp_path / "none")
    (tmp_path / "text.zip").write_text("no archive")
    with pytest.raises(otr.ArtefactError, match="cannot be read"):
        otr.from_sb3(tmp_path / "text")
    build(SAC, "Pendulum-v1", {"qf": [8]}, [3]).save(tmp_path / "model")
    whole = (tmp_path / "model.zip").read_bytes()
    for share in (0.0, 0.3, 0.6, 0.99):
        (tmp_path / "cut.zip").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(otr.ArtefactError):
            otr.from_sb3(tmp_path / "cut")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("data", "{}")
    with pytest.raises(otr.ArtefactError, match=r"holds no 'policy.pth', only \['data'\]"):
        otr.from_sb3(tmp_path / "other")


class Bomb:
    """Unpickling this writes the sentinel file."""

    def __init__(self, sentinel: Path) -> None:
        self.sentinel = sentinel

    def __reduce__(self) -> tuple:
        return Path.touch, (self.sentinel,)


def rewrite(source: Path, target: Path, members: dict[str, bytes]) -> None:
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            new.writestr(name, members.get(name, old.read(name)))


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
def test_code_in_a_model_file_is_not_run(tmp_path: Path) -> None:
    import base64

    sentinel = tmp_path / "sentinel"
    bomb = pickle.dumps(Bomb(sentinel))
    pickle.loads(bomb)
    assert sentinel.exists(), "the bomb works"
    sentinel.unlink()

    model = build(SAC, "Pendulum-v1", {"qf": [8]}, [6])
    model.save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        data = json.loads(archive.read("data"))
    for value in data.values():
        if isinstance(value, dict) and ":serialized:" in value:
            value[":serialized:"] = base64.b64encode(bomb).decode()
    members = {"data": json.dumps(data).encode(), "pytorch_variables.pth": bomb, "actor.optimizer.pth": bomb}
    rewrite(tmp_path / "model.zip", tmp_path / "crafted.zip", members)
    with pytest.raises(otr.InvalidNetworkError, match="give action_low="):
        otr.from_sb3(tmp_path / "crafted")
    box = model.action_space
    assert_predicts_as(model, otr.from_sb3(tmp_path / "crafted", action_low=box.low, action_high=box.high))
    assert not sentinel.exists()

    saved = io.BytesIO()
    torch.save({"actor.mu.weight": Bomb(sentinel)}, saved)
    for policy in (bomb, saved.getvalue()):
        rewrite(tmp_path / "model.zip", tmp_path / "crafted.zip", {"policy.pth": policy})
        with pytest.raises(otr.ArtefactError, match="holds more than tensors"):
            otr.from_sb3(tmp_path / "crafted")
    assert not sentinel.exists()


def test_what_a_file_does_not_tell_is_asked_for(tmp_path: Path) -> None:
    build(SAC, "Pendulum-v1", {"qf": [8]}, [6]).save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        data = json.loads(archive.read("data"))
    space, kwargs = data["action_space"], data["policy_kwargs"]
    changes = [
        ({"action_space": {**space, ":serialized:": data["policy_kwargs"][":serialized:"]}}, "give action_low="),
        ({"action_space": {**space, ":serialized:": "AAAA"}}, "give action_low="),
        ({"policy_kwargs": {**kwargs, "activation_fn": "functools.partial(LeakyReLU, 0.2)"}}, "give negative_slope="),
        ({"policy_class": {"__module__": "__main__"}}, "from '__main__'"),
    ]
    for change, message in changes:
        rewrite(tmp_path / "model.zip", tmp_path / "odd.zip", {"data": json.dumps({**data, **change}).encode()})
        with pytest.raises(otr.InvalidNetworkError, match=message):
            otr.from_sb3(tmp_path / "odd")
    leaky = {**data, **changes[2][0]}
    rewrite(tmp_path / "model.zip", tmp_path / "odd.zip", {"data": json.dumps(leaky).encode()})
    assert otr.from_sb3(tmp_path / "odd", negative_slope=0.2).negative_slope == 0.2


def test_reading_a_file_does_not_need_stable_baselines3(tmp_path: Path) -> None:
    build(SAC, "Pendulum-v1", {"qf": [8]}, [6]).save(tmp_path / "model")
    code = (
        "import sys; sys.modules['stable_baselines3'] = None\n"
        f"import otr; print(otr.from_sb3({str(tmp_path / 'model')!r}).n_hidden)"
    )
    out = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert out.stdout.strip() == "6"


def torch_answers(module: nn.Module, X: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return module.double().eval()(torch.from_numpy(X)).numpy()


def test_torch_sequentials() -> None:
    torch.manual_seed(0)
    X = np.random.default_rng(0).normal(size=(50, 3))
    modules = [
        nn.Sequential(nn.Linear(3, 2)),
        nn.Linear(3, 2),
        nn.Sequential(nn.Flatten(), nn.Linear(3, 4), nn.ReLU(), nn.Dropout(0.5), nn.Linear(4, 2), nn.Identity()),
        nn.Sequential(nn.Sequential(nn.Linear(3, 4, bias=False), nn.LeakyReLU(0.2)), nn.Linear(4, 2), nn.Tanh()),
        nn.Sequential(nn.Linear(3, 4), nn.Linear(4, 5), nn.ReLU(), nn.Linear(5, 5), nn.Linear(5, 1)),
        nn.Sequential(nn.Linear(3, 4), nn.ReLU()),
        nn.Sequential(nn.ReLU(), nn.Linear(3, 2)),
        nn.Sequential(nn.Linear(3, 2), nn.ReLU(), nn.Linear(2, 2), nn.LeakyReLU(0.1), nn.Linear(2, 1)),
        nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2).eval(), nn.ReLU(), nn.Linear(2, 1)),
        nn.Sequential(nn.Linear(3, 2), nn.PReLU(2), nn.Hardtanh(), nn.Linear(2, 1), nn.ReLU6()),
    ]
    for module in modules:
        network = otr.from_torch(module)
        np.testing.assert_allclose(network.predict(X), torch_answers(module, X), atol=1e-9)
        np.testing.assert_allclose(otr.map_network(network).predict(X), torch_answers(module, X), atol=1e-9)


def test_torch_classifiers() -> None:
    torch.manual_seed(0)
    X = np.random.default_rng(0).normal(size=(50, 3))
    binary = nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 1), nn.Sigmoid())
    labels = otr.from_torch(binary, head=otr.Sign()).predict(X)
    np.testing.assert_array_equal(labels, torch_answers(binary, X)[:, 0] > 0.5)
    several = nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 3), nn.Softmax(dim=1))
    labels = otr.from_torch(several, head=otr.Argmax()).predict(X)
    np.testing.assert_array_equal(labels, torch_answers(several, X).argmax(axis=1))


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (nn.Sequential(nn.Sequential(nn.Linear(3, 4), nn.Tanh()), nn.Linear(4, 1)), r"\(Tanh\) is not affine"),
        (nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4), nn.Linear(4, 1)), r"module\[1\] \(LayerNorm\) is not affine"),
        (nn.Sequential(nn.Linear(3, 1), nn.Sigmoid()), "head=otr.Sign"),
        (nn.Sequential(nn.Linear(3, 2), nn.Softmax(dim=1)), "head=otr.Argmax"),
        (nn.Sequential(), "no Linear layer"),
    ],
)
def test_torch_modules_that_are_refused(module: nn.Module, message: str) -> None:
    with pytest.raises(otr.InvalidNetworkError, match=message):
        otr.from_torch(module)


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_of_saved_trees_those_that_are_a_whole_network_are_read(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(0)
    network = otr.ReluNetwork([rng.normal(size=(3, 2)), rng.normal(size=(1, 3))], [rng.normal(size=3), [0.5]])
    tree = otr.PatternTree(network)
    otr.save(tree, tmp_path / "whole")
    np.testing.assert_array_equal(read_policy((tmp_path / "whole").with_suffix(suffix)).weights[0], network.weights[0])
    otr.save(tree.observe(rng.normal(size=(50, 2))).keep(1), tmp_path / "pruned")
    otr.save(otr.map_network(network), tmp_path / "mapped")
    for name, n_leaves in (("pruned", 1), ("mapped", 8)):
        with pytest.raises(otr.InvalidNetworkError, match=f"a tree of {n_leaves} leaves, which represents no network"):
            read_policy((tmp_path / name).with_suffix(suffix))
