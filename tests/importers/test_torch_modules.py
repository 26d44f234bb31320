"""Torch modules that do something else than their layers say."""

import copy
import warnings
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import nn

import otr

torch.set_num_threads(1)


def plain() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 2))


def hooked(part: int | None, hook: Callable, *, before: bool = False) -> nn.Module:
    module = plain()
    target = module if part is None else module[part]
    (target.register_forward_pre_hook if before else target.register_forward_hook)(hook)
    return module


class Doubled(nn.Sequential):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return 2 * super().forward(x)


class Absolute(nn.Identity):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.abs()


class Noisy(nn.Dropout):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + 1


class Shifted(nn.Linear):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return super().forward(x) + 1


class Called(nn.Linear):
    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        return super().__call__(x) + 1


def with_old_norm(norm: Callable, *, change: float = 1.0) -> nn.Module:
    module = plain()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        norm(module[0])
    module(torch.ones(1, 3))
    with torch.no_grad():
        for name, parameter in module[0].named_parameters():
            if name == "weight_g":
                parameter.mul_(change)
    return module


def with_own_forward() -> nn.Module:
    module = plain()
    module[0].forward = lambda x: torch.zeros(len(x), 4, dtype=x.dtype)
    return module


def on_one_state(_module: nn.Module, _inputs: tuple, out: torch.Tensor) -> torch.Tensor:
    """Act where no state that is tried lies."""
    return torch.where(out.abs().sum(dim=1, keepdim=True).sub(123.25).abs() < 1e-9, -out, out)


def with_hook_on_a_parametrisation() -> nn.Module:
    module = plain()
    nn.utils.parametrizations.weight_norm(module[0])
    module[0].parametrizations.weight[0].register_forward_hook(lambda _m, _i, out: None)
    return module


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (with_own_forward, r"module\[0\] has a forward of its own, .* torch.export.export\(module, \(states,\)\)"),
        (lambda: nn.Sequential(Called(3, 2)), r"module\[0\] has a __call__ of its own"),
        (
            lambda: hooked(0, lambda _m, _i, out: 1.001 * out),
            r"module\[0\] has a forward hook \(function\), which may change .*: remove it",
        ),
        (lambda: hooked(None, lambda _m, i: (i[0] + 1e-3,), before=True), "module has a forward hook"),
        (lambda: hooked(1, lambda _m, _i, _out: None), r"module\[1\] has a forward hook"),
        (lambda: nn.Sequential(hooked(1, on_one_state)), r"module\[0\]\[1\] has a forward hook"),
        (with_hook_on_a_parametrisation, r"module\[0\].parametrizations.weight\[0\] has a forward hook"),
        (lambda: with_old_norm(nn.utils.weight_norm, change=2), r"forward hook \(WeightNorm\).*remove_weight_norm"),
        (lambda: with_old_norm(nn.utils.spectral_norm), r"forward hook \(SpectralNorm\)"),
    ],
)
def test_a_module_that_does_something_else_is_refused(make: Callable, message: str) -> None:
    with pytest.raises(otr.InvalidNetworkError, match=message):
        otr.from_torch(make())


@pytest.mark.parametrize(
    ("name", "value"), [("0.weight", np.inf), ("0.bias", -np.inf), ("2.bias", np.nan), ("1.running_mean", np.nan)]
)
def test_numbers_that_are_not_finite_are_named(name: str, value: float) -> None:
    module = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, 2)).eval()
    module.state_dict()[name].view(-1)[0] = value
    with pytest.raises(otr.InvalidNetworkError, match=f"tensor '{name}': a weight or bias is not finite"):
        otr.from_torch(module)


class Agent(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.actor, self.critic = nn.Linear(3, 2), nn.Linear(3, 1)


class Recurrent(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.memory, self.last = nn.GRU(3, 4), nn.Linear(4, 2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(self.memory(x)[0])


def test_what_is_no_policy_of_a_state_says_what_to_do() -> None:
    for read in (otr.from_torch, otr.read_policy):
        with pytest.raises(otr.InvalidNetworkError, match=r"such as one of its parts \(module.actor, module.critic\)"):
            read(Agent())
        with pytest.raises(otr.InvalidNetworkError, match="the module remembers earlier states"):
            read(Recurrent())
    program = torch.export.export(Recurrent(), (torch.zeros(1, 3),))
    with pytest.raises(otr.InvalidNetworkError, match=r"\(gru\) remembers earlier states"):
        otr.read_policy(program)


def test_a_softmax_over_another_axis_is_refused() -> None:
    with pytest.raises(otr.InvalidNetworkError, match=r"module\[1\] \(Softmax\) goes over the states"):
        otr.from_torch(nn.Sequential(nn.Linear(3, 2), nn.Softmax(dim=0)), head=otr.Argmax())


@pytest.mark.parametrize("register", ["register_module_forward_hook", "register_module_forward_pre_hook"])
def test_a_hook_on_all_modules_is_seen(register: str) -> None:
    handle = getattr(nn.modules.module, register)(lambda *_given: None)
    try:
        with pytest.raises(otr.InvalidNetworkError, match="a forward hook on all modules is registered"):
            otr.from_torch(plain())
    finally:
        handle.remove()
    otr.from_torch(plain())


def parametrised(norm: Callable, part: int) -> nn.Module:
    module = plain()
    norm(module[part])
    return module


RELU, LINEAR = nn.ReLU(), nn.Linear(4, 4)
AS_THEIR_LAYERS = {
    "weight norm": lambda: parametrised(nn.utils.parametrizations.weight_norm, 0),
    "spectral norm": lambda: parametrised(nn.utils.parametrizations.spectral_norm, 0),
    "orthogonal": lambda: parametrised(nn.utils.parametrizations.orthogonal, 2),
    "bfloat16": lambda: plain().to(torch.bfloat16),
    "deep": lambda: nn.Sequential(*(layer for _ in range(6) for layer in (nn.Linear(64, 64), nn.ReLU()))),
    "linear layers": lambda: nn.Sequential(*(nn.Linear(64, 64) for _ in range(6))),
    "forward": lambda: Doubled(*plain()),
    "forward inside": lambda: nn.Sequential(Doubled(*plain())),
    "abs": lambda: nn.Sequential(nn.Linear(3, 2), Absolute()),
    "dropout that adds": lambda: nn.Sequential(Noisy(), nn.Linear(3, 2)),
    "linear that adds": lambda: nn.Sequential(Shifted(3, 2)),
    "a layer twice": lambda: nn.Sequential(nn.Linear(4, 5), RELU, nn.Linear(5, 4), RELU, LINEAR),
    "a block twice": lambda: nn.Sequential(*[nn.Sequential(LINEAR, RELU)] * 2),
}


@pytest.mark.parametrize("make", AS_THEIR_LAYERS.values(), ids=AS_THEIR_LAYERS)
def test_what_does_as_its_layers_is_read(make: Callable) -> None:
    module = make()
    before = copy.deepcopy(module.state_dict())
    network = otr.from_torch(module)
    assert module.training
    assert all(torch.equal(value, before[name]) for name, value in module.state_dict().items()), "left as it was"
    X = np.random.default_rng(3).normal(size=(50, network.n_inputs))
    with torch.no_grad():
        expected = copy.deepcopy(module).double().eval()(torch.from_numpy(X)).numpy()
    np.testing.assert_allclose(network.forward(X), expected, atol=1e-9)


def with_weight(weight: torch.Tensor) -> nn.Module:
    module = plain()
    module[0].weight = nn.Parameter(weight)
    return module


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: nn.Linear(3, 2, dtype=torch.complex64), r"'weight' holds complex numbers \(torch.complex64\)"),
        (lambda: with_weight(torch.ones(4, 3).to_sparse()), r"'0.weight' has the layout torch.sparse_coo"),
        (lambda: nn.Linear(3, 2, device="meta"), "'weight' is on the device 'meta'"),
        (lambda: nn.Sequential(nn.LazyLinear(2)), "'0.weight' is a UninitializedParameter"),
        (
            lambda: with_weight(torch.ones(1).expand(10**6, 10**6)),
            r"'0.weight' is expanded: its shape is \(1000000, 1000000\), 4 bytes are stored",
        ),
    ],
)
def test_tensors_that_are_no_matrices_of_numbers_are_refused(make: Callable, message: str) -> None:
    with pytest.raises(otr.InvalidNetworkError, match=message):
        otr.from_torch(make())


def test_the_head_of_a_module_that_ends_in_tanh() -> None:
    module = nn.Sequential(nn.Linear(3, 2), nn.Tanh())
    assert otr.from_torch(module, head=otr.TanhBox(-1.0, 1.0)).head == otr.TanhBox(-1.0, 1.0)
    with pytest.raises(otr.InvalidNetworkError, match=r"the model ends in Tanh: TanhBox\(.*\); leave head out"):
        otr.from_torch(module, head=otr.TanhBox(-2.0, 2.0))
