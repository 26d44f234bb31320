"""Networks of smooth units answer as torch's do."""

import numpy as np
import pytest
import torch

import otr
from otr.core.smooth_network import ACTIVATIONS, SmoothNetwork

UNITS = {name.lower(): getattr(torch.nn, name) for name in (
    "Tanh", "Sigmoid", "SiLU", "ELU", "GELU", "CELU", "SELU", "Softplus", "Softsign", "Mish", "LogSigmoid", "Hardtanh",
    "ReLU6", "Hardsigmoid", "Hardswish",
)}  # fmt: skip


def module_of(activation):
    torch.manual_seed(0)
    unit = UNITS[activation]
    return torch.nn.Sequential(
        torch.nn.Linear(3, 5), unit(), torch.nn.Linear(5, 4), unit(), torch.nn.Linear(4, 2)
    ).double()


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_it_computes_what_torch_does(activation):
    module = module_of(activation)
    layers = [layer for layer in module if isinstance(layer, torch.nn.Linear)]
    arrays = [[getattr(layer, name).detach().numpy() for layer in layers] for name in ("weight", "bias")]
    network = SmoothNetwork(*arrays, activation=activation, head=otr.TanhBox(-2, 2))
    X = np.random.default_rng(0).normal(scale=20, size=(50, 3))
    outputs = module(torch.tensor(X)).detach().numpy()
    np.testing.assert_allclose(network.forward(X), outputs, atol=1e-14)
    np.testing.assert_allclose(network.predict(X[0]), 2 * np.tanh(outputs[0]), atol=1e-14)
    folded = network.fold_input_normalisation([1.0, 2.0, 3.0], 2.0)
    np.testing.assert_allclose(folded.forward(2 * X + [1.0, 2.0, 3.0]), outputs, atol=1e-13)
    assert network.replace(head=otr.Argmax()).predict(X).tolist() == outputs.argmax(axis=1).tolist()


def test_an_unknown_activation_is_named():
    with pytest.raises(otr.InvalidNetworkError, match="the activation is 'sine', expected one of tanh"):
        SmoothNetwork([np.ones((1, 1))], [np.zeros(1)], activation="sine")
