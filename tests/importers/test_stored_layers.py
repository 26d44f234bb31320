"""Files of layers alone: `.nnet`, and the state_dict of a torch module."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import otr
from otr.importers import read_policy

RNG = np.random.default_rng(0)
W1, B1, W2, B2 = RNG.normal(size=(4, 3)), RNG.normal(size=4), RNG.normal(size=(2, 4)), RNG.normal(size=2)
LOW, HIGH, MEAN, SCALE = [-1.0, -2, -3], [4.0, 5, 6], [0.5, 1, -1, 7], [2.0, 3, 4, 10]


def nnet(path: Path, *, sizes: str = "3,4,2,", n_dropped: int = 0) -> Path:
    rows = [[2, 3, 2, 4], None, [0], LOW, HIGH, MEAN, SCALE, *W1, *B1[:, None], *W2, *B2[:, None]]
    lines = [sizes if row is None else ",".join(repr(float(v)) for v in row) + "," for row in rows]
    lines[0] = "2,3,2,4,"
    path.write_text("\n".join(["// a header", "// of text", *lines[: len(lines) - n_dropped]]) + "\n")
    return path


def test_an_nnet_file_takes_raw_states_in_its_box(tmp_path: Path) -> None:
    network = read_policy(nnet(tmp_path / "acas.nnet"))
    X = RNG.uniform(LOW, HIGH, size=(100, 3))
    hidden = np.maximum((X - MEAN[:3]) / SCALE[:3] @ W1.T + B1, 0)
    np.testing.assert_allclose(network.predict(X), (hidden @ W2.T + B2) * 10 + 7, atol=1e-12)
    np.testing.assert_array_equal(network.domain.low, LOW)
    np.testing.assert_array_equal(network.domain.high, HIGH)
    for changes, message in (({"n_dropped": 1}, "holds 25 weights and biases"), ({"sizes": "3,x"}, "no .nn"),
                             ({"sizes": "3,4,4,2,"}, "declares 2 layers of 3 inputs and 2 outputs")):  # fmt: skip
        with pytest.raises(otr.ArtefactError, match=message):
            read_policy(nnet(tmp_path / "acas.nnet", **changes))


class Agent(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.critic = nn.Sequential(nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 1))
        self.actor = nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 2))
        self.log_std = nn.Parameter(torch.zeros(2))


@pytest.mark.parametrize("nested", [False, True])
def test_layers_of_a_state_dict(tmp_path: Path, nested: bool) -> None:
    agent, path = Agent(), tmp_path / "agent.pth"
    state = agent.state_dict()
    torch.save({"model": state, "epoch": 3} if nested else state, path)
    prefix = "model.actor" if nested else "actor"
    with pytest.raises(otr.InvalidNetworkError, match=rf"do not chain; .* layers='{prefix}' or .*critic.0.weight"):
        read_policy(path)
    with pytest.raises(otr.InvalidNetworkError, match=r"give activation= one of .*relu"):
        read_policy(path, layers=prefix)
    X = RNG.normal(size=(50, 3))
    expected = agent.actor.double()(torch.from_numpy(X)).detach().numpy()
    for layers in (prefix, [f"{prefix}.0", f"{prefix}.2"]):
        with pytest.warns(UserWarning, match=r"read are .*actor.2, not .*log_std \(2,\)"):
            policy = read_policy(path, layers=layers, activation="relu")
        np.testing.assert_allclose(policy.predict(X), expected, atol=1e-12)


def test_layers_are_put_together_as_the_module_has_them(tmp_path: Path) -> None:
    """As in skrl, whose last layer has another name than those before it."""
    parts = nn.ModuleDict({"net": nn.Sequential(nn.Linear(3, 4), nn.ELU(), nn.Linear(4, 4)), "last": nn.Linear(4, 2)})
    torch.save({"policy": parts.state_dict(), "value": parts.state_dict()}, tmp_path / "agent.pt")
    with pytest.warns(UserWarning, match=r"read are policy.net.0, policy.net.2, policy.last, not"):
        policy = read_policy(tmp_path / "agent.pt", layers="policy", activation="elu")
    X = RNG.normal(size=(20, 3))
    expected = nn.Sequential(*parts["net"], nn.ELU(), parts["last"]).double()(torch.from_numpy(X)).detach().numpy()
    np.testing.assert_allclose(policy.predict(X), expected, atol=1e-12)


def test_layers_that_alone_chain_need_no_names(tmp_path: Path) -> None:
    module = nn.Sequential(*(layer for k in range(12) for layer in (nn.Linear(3 + k, 4 + k), nn.Tanh())))[:-1]
    torch.save(module.state_dict(), tmp_path / "policy.pt")
    policy = read_policy(tmp_path / "policy.pt", activation="tanh")
    X = RNG.normal(size=(50, 3))
    np.testing.assert_allclose(policy.predict(X), module.double()(torch.from_numpy(X)).detach().numpy(), atol=1e-12)


def test_a_normalisation_among_the_layers_is_not_left_out(tmp_path: Path) -> None:
    torch.save(nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4), nn.Linear(4, 2)).state_dict(), tmp_path / "policy.pt")
    with pytest.raises(otr.InvalidNetworkError, match=r"do not chain; .*1.weight \(4,\)"):
        read_policy(tmp_path / "policy.pt", activation="relu")


@pytest.mark.filterwarnings("ignore")
def test_what_is_no_state_dict_says_how_to_export(tmp_path: Path) -> None:
    module = nn.Sequential(nn.Linear(3, 2))
    torch.jit.save(torch.jit.trace(module, torch.zeros(1, 3)), tmp_path / "script.pt")
    with pytest.raises(otr.InvalidNetworkError, match=r"is TorchScript, which holds code; save module.state_dict"):
        read_policy(tmp_path / "script.pt")
    torch.save(module, tmp_path / "whole.pth")
    with pytest.raises(
        otr.ArtefactError,
        match=r"more than tensors, and was not loaded: it names torch.*; save module.state_d",
    ):
        read_policy(tmp_path / "whole.pth")
    with pytest.raises(otr.InvalidNetworkError, match=r"layers= and activation= are for a state_dict"):
        read_policy(tmp_path / "policy.onnx", activation="relu")
