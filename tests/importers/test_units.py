"""Which units are read, whatever the file: a refusal offers to imitate a policy where it can be read for that alone."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from torch import nn

import otr
from otr.core.smooth_network import SmoothNetwork
from otr.importers import read_policy
from tests.importers.test_importers import FourActions, build
from tests.importers.test_torch_export import exported, written

torch.set_num_threads(1)

READ = ["CELU", "ELU", "GELU", "Hardsigmoid", "Hardswish", "Hardtanh", "LogSigmoid", "Mish", "ReLU6", "SELU", "SiLU",
        "Sigmoid", "Softplus", "Softsign", "Tanh"]  # fmt: skip

NOT_READ = ["PReLU", "RReLU", "Tanhshrink"]
PIECEWISE = ["Hardtanh", "PReLU", "RReLU", "ReLU6"]  # ReLU neurons in an export
REMEDY = "imitate the policy"


def refusal(read: Callable, path: Path) -> str:
    with pytest.raises(otr.InvalidNetworkError) as caught:
        read(path)
    return str(caught.value)


@pytest.mark.parametrize("name", [*READ, *NOT_READ])
def test_units_of_a_zip(tmp_path: Path, name: str) -> None:
    model = build(PPO, FourActions(), {"vf": [8]}, [6, 5], getattr(nn, name))
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.normal_()
    model.save(tmp_path / "model.zip")
    assert (REMEDY in refusal(otr.from_sb3, tmp_path / "model.zip")) is (name in READ)
    if name in NOT_READ:
        told = "are [0, 1, 2, 3], expected [0, 2, 4, 6]" if name == "PReLU" else "or read the policy from its export"
        assert told in refusal(read_policy, tmp_path / "model.zip")
        return
    policy = read_policy(tmp_path / "model.zip")
    assert isinstance(policy, SmoothNetwork) and policy.activation == name.lower()
    X = np.random.default_rng(0).normal(scale=3, size=(200, 3)).astype(np.float32)
    np.testing.assert_array_equal(policy.predict(X), model.predict(X, deterministic=True)[0])


@pytest.mark.parametrize("name", [*READ, *NOT_READ])
def test_units_of_an_export(tmp_path: Path, name: str) -> None:
    """Those that are no ReLU neurons are an oracle, which torch runs."""
    torch.manual_seed(0)
    module = nn.Sequential(nn.Linear(3, 6), getattr(nn, name)(), nn.LayerNorm(6), nn.Linear(6, 2)).double().eval()
    module = module if name not in PIECEWISE else nn.Sequential(*module[:2], module[3])
    path = written(exported(module, states=torch.zeros(1, 3, dtype=torch.float64)), tmp_path / "policy.pt2")
    X = np.random.default_rng(0).normal(scale=3, size=(50, 3))
    with torch.no_grad():
        expected = module(torch.from_numpy(X)).numpy()
    policy = read_policy(path)
    np.testing.assert_allclose(policy.forward(X), expected, atol=1e-12)
    if name in PIECEWISE:
        np.testing.assert_allclose(otr.map_network(otr.from_torch(path)).predict(X), expected, atol=1e-12)
        return
    assert "let a tree imitate the model as it is: otr.imitate(" in refusal(otr.from_torch, path)
    np.testing.assert_array_equal(policy.first_layer[:, :3], module[0].weight.detach().numpy())


def test_a_leaky_relu_of_another_slope_has_its_remedy(tmp_path: Path) -> None:
    model = build(PPO, FourActions(), {"vf": [8]}, [6], partial(nn.LeakyReLU, 0.2))
    model.save(tmp_path / "model.zip")
    for read in (otr.from_sb3, read_policy):
        told = refusal(read, tmp_path / "model.zip")
        assert "for this LeakyReLU, give negative_slope= to otr.from_sb3" in told and REMEDY not in told
    assert otr.from_sb3(tmp_path / "model.zip", negative_slope=0.2).negative_slope == 0.2
