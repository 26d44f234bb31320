"""Files of Stable-Baselines3 that hold more, less or something else than a policy of today's layout."""

import functools
import io
import json
import struct
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from torch import nn

import otr
from tests.importers.test_importers import FourActions, WideBox, assert_predicts_as, build, rewrite

torch.set_num_threads(1)

SHARED, POLICY = "mlp_extractor.shared_net", "mlp_extractor.policy_net"


def changed(source: Path, target: Path, change: Callable[[dict], dict], data: dict | None = None) -> None:
    """Write the model again with other tensors, and with some entries of its `data` changed."""
    with zipfile.ZipFile(source) as archive:
        tensors = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
        entries = json.loads(archive.read("data")) | (data or {})
    policy = io.BytesIO()
    torch.save(change(tensors), policy)
    rewrite(source, target, {"policy.pth": policy.getvalue(), "data": json.dumps(entries).encode()})


def layers_shared(n_shared: int) -> Callable[[dict], dict]:
    """Return the change to the layout before version 1.8, with the first layers shared by actor and critic."""

    def change(tensors: dict) -> dict:
        renamed = {}
        for name, tensor in tensors.items():
            if name.startswith(POLICY):
                _, _, position, kind = name.split(".")
                layer = int(position) // 2
                name = f"{SHARED if layer < n_shared else POLICY}.{2 * (layer - n_shared * (layer >= n_shared))}.{kind}"
            if not name.startswith("mlp_extractor.value_net"):
                renamed[name] = tensor
        return renamed

    return change


@pytest.mark.parametrize("n_shared", [1, 2, 3])
@pytest.mark.parametrize("env", [FourActions(), WideBox()], ids=["labels", "box"])
def test_layers_shared_by_actor_and_critic(tmp_path: Path, env: object, n_shared: int) -> None:
    model = build(PPO, env, {"vf": [8]}, [3, 3, 3])  # as wide as the inputs, so that a lost layer would not show
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.normal_()
    model.save(tmp_path / "model")
    changed(tmp_path / "model.zip", tmp_path / "old.zip", layers_shared(n_shared))
    network = otr.from_sb3(tmp_path / "old")
    assert network.hidden_widths == (3, 3, 3)
    assert_predicts_as(model, network)


def test_tanh_is_refused_where_all_layers_are_shared(tmp_path: Path) -> None:
    build(PPO, FourActions(), {"vf": [8]}, [3, 3], nn.Tanh).save(tmp_path / "model")
    changed(tmp_path / "model.zip", tmp_path / "old.zip", layers_shared(2))
    with pytest.raises(otr.InvalidNetworkError, match=r"Tanh.*activation_fn=torch\.nn\.ReLU.*imitate the policy"):
        otr.from_sb3(tmp_path / "old")
    changed(tmp_path / "model.zip", tmp_path / "old.zip", layers_shared(2), {"policy_kwargs": None})
    with pytest.raises(otr.InvalidNetworkError, match="does not give the policy's arguments"):
        otr.from_sb3(tmp_path / "old")


def test_widths_are_compared_with_the_spaces(tmp_path: Path) -> None:
    for env, wide, narrow in (
        (FourActions(), "4 outputs, the action space has 3 actions", {"n": "3"}),
        (WideBox(), "3 outputs, the action space has 2 actions", {"_shape": [2]}),
    ):
        model = build(PPO, env, {"vf": [8]}, [3, 3])
        model.save(tmp_path / "model")
        with zipfile.ZipFile(tmp_path / "model.zip") as archive:
            data = json.loads(archive.read("data"))
        for data_change, message in (
            ({"observation_space": {**data["observation_space"], "_shape": [2, 2]}}, "3 inputs, the observation space"),
            ({"observation_space": {**data["observation_space"], "_shape": None}}, "does not give the size of the obs"),
            ({"action_space": {**data["action_space"], **narrow}}, wide),
        ):
            changed(tmp_path / "model.zip", tmp_path / "odd.zip", dict, data_change)
            with pytest.raises(otr.InvalidNetworkError, match=message):
                otr.from_sb3(tmp_path / "odd")
    model.policy.action_net = nn.Linear(3, 2)
    with pytest.raises(otr.InvalidNetworkError, match=r"has 2 outputs, the action space has 3 actions"):
        otr.from_sb3(model, action_low=[-1, -1], action_high=[1, 1])
    model = build(SAC, "Pendulum-v1", {"qf": [8]}, [3])
    model.policy.actor.latent_pi[0] = nn.Linear(5, 3)
    with pytest.raises(otr.InvalidNetworkError, match="reads 5 inputs, the observation space has 3 numbers"):
        otr.from_sb3(model)


def test_a_live_model_that_predicts_something_else_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for model in (
        build(SAC, WideBox(), {"qf": [8]}, [4]),
        build(PPO, WideBox(), {"vf": [8]}, [4]),
        build(PPO, FourActions(), {"vf": [8]}, [4]),
    ):
        otr.from_sb3(model)
        last = model.policy.actor.mu if isinstance(model, SAC) else model.policy.action_net
        name = "actor.mu" if isinstance(model, SAC) else "action_net"
        for part, where in ((last, f"policy.{name}"), (model.policy, "policy")):
            hook = part.register_forward_hook(lambda _m, _i, _out: None)
            with pytest.raises(otr.InvalidNetworkError, match=f"^{where} has a forward hook .function., which may"):
                otr.from_sb3(model)
            hook.remove()
            otr.from_sb3(model)
        model.policy.predict = None
        with pytest.raises(otr.InvalidNetworkError, match=r"^policy has a predict of its own, which may do something"):
            otr.from_sb3(model)
        del model.policy.predict
        with monkeypatch.context() as patch:
            predict = type(model.policy)._predict
            patch.setattr(type(model.policy), "_predict", lambda *given, predict=predict, **more: 0 * predict(*given))
            with pytest.raises(otr.InvalidNetworkError, match="predicts differently from its layers: in state"):
                otr.from_sb3(model)


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_a_model_that_was_trained_is_read_and_stays_as_it_is(algorithm: type) -> None:
    critic, options = ({"vf": [8]}, {"n_steps": 8, "batch_size": 8}) if algorithm is PPO else ({"qf": [8]}, {})
    model = build(algorithm, WideBox(), critic, [4], **options).learn(16)
    for mode in (True, False):
        model.policy.set_training_mode(mode)
        before = [part.training for part in model.policy.modules()]
        network = otr.from_sb3(model)
        assert [part.training for part in model.policy.modules()] == before
        assert_predicts_as(model, network)


def test_what_a_live_model_does_otherwise_than_its_file_says_is_read_or_refused() -> None:
    leaky = build(SAC, WideBox(), {"qf": [8]}, [4, 4], functools.partial(nn.LeakyReLU, negative_slope=0.2))
    network = otr.from_sb3(leaky)  # its file does not say the slope
    assert network.negative_slope == 0.2
    assert_predicts_as(leaky, network)
    model = build(SAC, WideBox(), {"qf": [8]}, [4, 4])
    model.policy.actor.latent_pi[1] = nn.Tanh()
    with pytest.raises(otr.InvalidNetworkError, match="the model predicts differently from its layers: in state"):
        otr.from_sb3(model)
    model.lock = threading.Lock()
    with pytest.raises(otr.InvalidNetworkError, match=r"model\.save fails, .* cannot pickle '_thread\.lock' object"):
        otr.from_sb3(model)


def replaced(name: str, tensor: object) -> Callable[[dict], dict]:
    return lambda tensors: {**tensors, name: tensor}


@pytest.mark.parametrize(
    ("name", "tensor", "error", "message"),
    [
        ("weight", torch.ones(1, 4, dtype=torch.complex64), otr.InvalidNetworkError, "holds complex numbers"),
        ("weight", torch.ones(1, 4, dtype=torch.int64), otr.InvalidNetworkError, "expected real floating-point"),
        ("weight", torch.ones(1, 5), otr.InvalidNetworkError, "layer 1 of 2: weight has 5 columns"),
        ("weight", torch.full((1, 4), torch.nan), otr.InvalidNetworkError, "not finite"),
        ("weight_g", torch.ones(1, 1), otr.InvalidNetworkError, "the tensor 'actor.mu.weight_g', which no Linear"),
        ("weight", 3, otr.ArtefactError, "no dictionary of tensors by name"),
        ("weight", torch.ones(1, 4, dtype=torch.complex64).imag, None, ""),
    ],
)
def test_tensors_that_are_no_matrices_of_numbers(
    tmp_path: Path, name: str, tensor: object, error: type | None, message: str
) -> None:
    build(SAC, "Pendulum-v1", {"qf": [8]}, [4]).save(tmp_path / "model")
    changed(tmp_path / "model.zip", tmp_path / "odd.zip", replaced(f"actor.mu.{name}", tensor))
    if error is None:
        assert otr.from_sb3(tmp_path / "odd").weights[1].tolist() == [[0, 0, 0, 0]]
        return
    with pytest.raises(error, match=message):
        otr.from_sb3(tmp_path / "odd")


def declared(content: bytes, name: str, n_bytes: int) -> bytes:
    """Return the zip file with another size in the directory's entry of a member."""
    at = content.index(b"PK\1\2")
    while content[at + 46 : at + 46 + len(name)] != name.encode():
        at = content.index(b"PK\1\2", at + 4)
    return content[: at + 24] + struct.pack("<I", n_bytes) + content[at + 28 :]


@pytest.mark.parametrize("member", ["data", "policy.pth", "inside policy.pth"])
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, member: str) -> None:
    build(SAC, "Pendulum-v1", {"qf": [8]}, [4]).save(tmp_path / "model")
    whole = (tmp_path / "model.zip").read_bytes()
    if member == "inside policy.pth":
        with zipfile.ZipFile(tmp_path / "model.zip") as archive:
            policy = archive.read("policy.pth")
        inner = zipfile.ZipFile(io.BytesIO(policy)).namelist()[-1]
        rewrite(tmp_path / "model.zip", tmp_path / "bomb.zip", {"policy.pth": declared(policy, inner, 3 * 2**30)})
    else:
        (tmp_path / "bomb.zip").write_bytes(declared(whole, member, 3 * 2**30))
    with pytest.raises(otr.ArtefactError, match=r"unpacks to 3,22\d,\d{3},\d{3} bytes, the limit is .*nothing was unp"):
        otr.from_sb3(tmp_path / "bomb")


def test_torch_sees_the_checked_members_only(tmp_path: Path) -> None:
    """What stands before and after the inner zip file's own members is never given to torch."""
    model = build(SAC, "Pendulum-v1", {"qf": [8]}, [4])
    model.save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        policy = archive.read("policy.pth")
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(policy)) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    rewrite(tmp_path / "model.zip", tmp_path / "packed.zip", {"policy.pth": packed.getvalue()})
    np.testing.assert_array_equal(otr.from_sb3(tmp_path / "packed").weights[0], otr.from_sb3(model).weights[0])


@pytest.mark.parametrize("data", [b"[" * 200_000, b"\xff\xfe", b"[]", b'{"policy_class": 3}', b"{"])
def test_text_that_is_no_description(tmp_path: Path, data: bytes) -> None:
    build(SAC, "Pendulum-v1", {"qf": [8]}, [4]).save(tmp_path / "model")
    rewrite(tmp_path / "model.zip", tmp_path / "odd.zip", {"data": data})
    with pytest.raises((otr.ArtefactError, otr.InvalidNetworkError)):
        otr.from_sb3(tmp_path / "odd")


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_the_action_box_is_exact_however_numpy_prints(tmp_path: Path, algorithm: type) -> None:
    """Stable-Baselines3 writes the box as text, by numpy's options of the moment, beside the pickle."""
    env = WideBox()
    model = build(algorithm, env, {"vf": [8]} if algorithm is PPO else {"qf": [8]}, [3])
    with np.printoptions(precision=1, suppress=True, threshold=2):
        model.save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        assert "0.3333" not in json.loads(archive.read("data"))["action_space"]["high"]
    network = otr.from_sb3(tmp_path / "model")
    np.testing.assert_array_equal(network.head.low, env.action_space.low)
    np.testing.assert_array_equal(network.head.high, env.action_space.high)
    assert_predicts_as(model, network)
