"""Networks read from torch exports: against what the exported modules answer, and what is refused or never opened."""

import copy
import io
import json
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import otr
from otr.importers import read_policy
from tests.importers.test_importers import Bomb, rewrite

torch.set_num_threads(1)
STATES = torch.from_numpy(np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)) * 2


class Policy(nn.Module):
    """Layers and constants with a `forward` of one's own."""

    def __init__(self, forward: Callable) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.one, self.two, self.own = nn.Linear(4, 5), nn.Linear(5, 2), forward
        self.register_buffer("mean", torch.randn(4))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.own(self, x)


def sequential(*layers: nn.Module) -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(4, 5), layers[0], nn.Linear(5, 3), layers[0], nn.Linear(3, 2), *layers[1:])


def exported(
    module: nn.Module, *, states: torch.Tensor = STATES[:1], **options: object
) -> torch.export.ExportedProgram:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return torch.export.export(module.eval(), (states,), **options)


def written(program: torch.export.ExportedProgram, path: Path) -> Path:
    torch.export.save(program, path)
    return path


def assert_answers(network: otr.ReluNetwork, module: nn.Module) -> None:
    with torch.no_grad():
        expected = copy.deepcopy(module).double()(STATES.double()).numpy()
    np.testing.assert_allclose(network.predict(STATES.numpy()), expected, rtol=0, atol=1e-12)
    assert len(np.unique(expected, axis=0)) > 1


MAPPED = {
    "layers": (lambda: sequential(nn.ReLU(True), nn.Dropout(), nn.Tanh()), otr.TanhBox(-1, 1)),
    "leaky": (lambda: sequential(nn.LeakyReLU(0.25), nn.Hardtanh(-0.5, 0.25)), otr.ClipBox([-0.5] * 2, [0.25] * 2)),
    "normalised": (
        lambda: Policy(lambda m, x: m.two(torch.relu(m.one(((x - m.mean) / 0.5).flatten(1))))),
        otr.Identity(),
    ),
    "tanh of a box": (
        lambda: Policy(lambda m, x: torch.tanh(m.two(torch.relu(m.one(1 - 2 * x)))) * 2 + 0.5),
        otr.TanhBox([-1.5] * 2, [2.5] * 2),
    ),
    "matrices": (
        lambda: Policy(lambda m, x: torch.relu(x @ m.one.weight.T + m.one.bias) @ m.two.weight.t() - m.two.bias),
        otr.Identity(),
    ),
    "clamp": (
        lambda: Policy(lambda m, x: m.two(torch.relu(m.one(x.view(-1, 4)))).clamp_(-0.25, 0.5).reshape(1, 2)),
        otr.ClipBox([-0.25] * 2, [0.5] * 2),
    ),
    "where": (
        lambda: Policy(lambda m, x: m.two(torch.where((z := m.one(x)) > 0, z, 0))),
        otr.Identity(),
    ),
    "times a comparison": (lambda: Policy(lambda m, x: m.two((z := m.one(x)) * (z > 0))), otr.Identity()),
    "a constant in forward": (
        lambda: Policy(lambda m, x: torch.tanh(m.two(torch.relu(m.one(x)))) * torch.tensor([2.0, 0.5])),
        otr.TanhBox([-2, -0.5], [2, 0.5]),
    ),
    "labels": (lambda: Policy(lambda m, x: m.two(torch.relu(m.one(x))).argmax(dim=1)), otr.Argmax()),
}


@pytest.mark.parametrize("name", MAPPED)
def test_answers_are_the_modules(tmp_path: Path, name: str) -> None:
    make, head = MAPPED[name]
    module = make()
    program = exported(module)
    network = otr.from_torch(written(program, tmp_path / "policy.pt2"))
    assert network.head == head and network.n_hidden in (5, 8)
    if name == "clamp":  # its shape is of one state
        module.own = lambda m, x: m.two(torch.relu(m.one(x))).clamp(-0.25, 0.5)
    assert_answers(network, module)
    if name == "leaky":
        assert_answers(otr.from_torch(program), module)
        assert_answers(otr.map_network(network), module)


def test_any_number_of_states_and_none() -> None:
    any_number = {"dynamic_shapes": ({0: torch.export.Dim("n")},)}
    module = Policy(lambda m, x: m.two(torch.relu(m.one(x.reshape(x.shape[0], -1)))))
    assert_answers(otr.from_torch(exported(module, states=STATES[:3].reshape(3, 2, 2), **any_number)), module)
    module = sequential(nn.ReLU())
    assert_answers(otr.from_torch(exported(module, states=STATES[0])), module)


def test_tanh_units_and_a_module_are_an_oracle(tmp_path: Path) -> None:
    module = Policy(lambda m, x: m.two(torch.tanh(m.one(x)) * 2 + 0.5).softmax(dim=1))
    for given in (written(exported(module), tmp_path / "policy.pt2"), exported(module), module):
        policy = read_policy(given)
        assert policy.head == otr.Argmax() and policy.suffix == ".pt2"
        np.testing.assert_array_equal(policy.predict(STATES.numpy()), module(STATES).argmax(dim=1).numpy())
    relu = read_policy(sequential(nn.ReLU()))
    assert isinstance(relu, otr.ReluNetwork)
    with pytest.raises(otr.InvalidNetworkError, match=r"not from a float; .*predict"):
        read_policy(3.0)


def test_what_is_chosen_by_a_comparison_is_an_oracle() -> None:
    chosen = Policy(lambda m, x: m.two(torch.where((z := m.one(x)) > 0, z, z.exp())).softmax(dim=1))
    policy = read_policy(chosen)
    assert policy.suffix == ".pt2" and policy.head == otr.Argmax()
    np.testing.assert_array_equal(policy.predict(STATES.numpy()), chosen(STATES).argmax(dim=1).numpy())
    two = Policy(lambda m, x: torch.where(m.two(m.one(x)) > 0, 2.0, -2.0))
    np.testing.assert_array_equal(read_policy(two).predict(STATES.numpy()), two(STATES).numpy())
    for module in (chosen, two):
        with pytest.raises(otr.InvalidNetworkError, match=r"^node 'gt' \(gt\) is not affine"):
            otr.from_torch(module)


def test_weights_that_are_not_finite(tmp_path: Path) -> None:
    module = sequential(nn.ReLU())
    with torch.no_grad():
        module[2].weight[0, 0] = torch.nan
    path = written(exported(module), tmp_path / "policy.pt2")
    for read in (otr.from_torch, read_policy):
        for given in (path, module):
            with pytest.raises(otr.InvalidNetworkError, match=r"2.weight'.* a weight or bias is not finite"):
                read(given)


def test_probabilities_are_decided_or_need_their_head(tmp_path: Path) -> None:
    module = sequential(nn.ReLU(), nn.Softmax(dim=1))
    path = written(exported(module), tmp_path / "policy.pt2")
    labels = module(STATES).argmax(dim=1).numpy()
    np.testing.assert_array_equal(otr.from_torch(path, head=otr.Argmax()).predict(STATES.numpy()), labels)
    np.testing.assert_array_equal(read_policy(path).predict(STATES.numpy()), labels)
    with pytest.raises(otr.InvalidNetworkError, match=r"ends in Softmax; it needs head=otr.Argmax\(\)"):
        otr.from_torch(path)


def changed_in_place(m: Policy, x: torch.Tensor) -> torch.Tensor:
    z = m.one(x)
    z.detach().relu_()
    return m.two(z)


@pytest.mark.parametrize(
    ("forward", "message"),
    [
        (lambda m, x: m.two(torch.cos(m.one(x))), r"node 'cos' \(cos\) is not affine, and no unit"),
        (changed_in_place, "the model answers differently from its layers"),
        (lambda m, x: (m.two(m.one(x)), m.mean), "makes 2 results, expected one of each"),
        (lambda m, x: m.two(torch.relu(m.one(x))).argmax(dim=0), r"\(argmax\) is not affine"),
        (lambda m, x: m.two(torch.relu(m.one(x))).softmax(dim=0), r"\(softmax\) goes over the states"),
        (lambda m, x: m.two(torch.relu(m.one(x.half().float()))), r"'to' \(to\) is not affine"),
        (
            lambda m, x: m.two(nn.functional.dropout(m.one(x))),
            r"'dropout' \(dropout\) answers differently every time; .* module.eval",
        ),
        (lambda m, x: m.two(nn.functional.gelu(m.one(x), approximate="tanh")), r"\(gelu\) is not affine, and no unit"),
        (lambda m, x: m.two(m.one(x)).expand(10**8, 2), "makes 200,000,000 numbers of a state, the limit is"),
    ],
)
def test_what_is_refused(forward: Callable, message: str) -> None:
    with pytest.raises(otr.InvalidNetworkError, match=message):
        otr.from_torch(exported(Policy(forward)))


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(exported(sequential(nn.ReLU())), tmp_path_factory.mktemp("saved") / "policy.pt2")


@pytest.mark.filterwarnings("ignore:Unable to load")
def test_no_pickle_is_opened(saved: Path, tmp_path: Path) -> None:
    """torch.export.load runs the code in one. That of a tensor is named here, that of the example states is skipped."""
    sentinel = tmp_path / "sentinel"
    bomb = io.BytesIO()
    torch.save(Bomb(sentinel), bomb)
    with zipfile.ZipFile(saved) as archive:
        names = {name.partition("/")[2]: name for name in archive.namelist()}
        config = json.loads(archive.read(names["data/weights/model_weights_config.json"]))
    payload = config["config"]["0.weight"]
    payload["use_pickle"] = True
    bad = {
        names["data/weights/model_weights_config.json"]: json.dumps(config).encode(),
        names[f"data/weights/{payload['path_name']}"]: bomb.getvalue(),
    }
    rewrite(saved, tmp_path / "weight.pt2", bad)
    with pytest.raises(otr.InvalidNetworkError, match=r"'0.weight' is kept as a pickle, which is not opened"):
        otr.from_torch(tmp_path / "weight.pt2")
    rewrite(saved, tmp_path / "example.pt2", {names["data/sample_inputs/model.pt"]: bomb.getvalue()})
    assert otr.from_torch(tmp_path / "example.pt2").n_hidden == 8
    assert not sentinel.exists()
    with pytest.raises(Exception):  # noqa: B017 - whatever torch makes of it
        torch.export.load(tmp_path / "weight.pt2")
    assert sentinel.exists(), "the bomb works"


def changed(saved: Path, target: Path, name: str, change: Callable) -> Path:
    with zipfile.ZipFile(saved) as archive:
        (member,) = [each for each in archive.namelist() if each.endswith(name)]
        about = json.loads(archive.read(member))
    change(about)
    rewrite(saved, target, {member: json.dumps(about).encode()})
    return target


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("models/model.json", lambda about: about.pop("graph_module"), "in another form than is read here .version .*"),
        ("models/model.json", lambda about: about["graph_module"]["graph"]["nodes"][0].pop("target"), "another form"),
        (
            "models/model.json",
            lambda about: about["graph_module"]["graph"]["nodes"][0]["inputs"].pop(1),
            r"node 'linear' \(linear\) cannot be run on the shapes \[\(1, 4\), \(5,\)\]: .* missing value for argument",
        ),
        (
            "weights_config.json",
            lambda about: about["config"]["0.weight"]["tensor_meta"].update(storage_offset={"as_int": 1}),
            r"'0.weight' shows the shape \(5, 4\), 20 numbers are stored",
        ),
        (
            "weights_config.json",
            lambda about: about["config"]["0.weight"]["tensor_meta"].update(sizes=[{"as_int": 10**9}] * 2, strides=[
                {"as_int": 0}] * 2),
            "20 numbers are stored",
        ),
        ("weights_config.json", lambda about: about["config"].pop("0.weight"), "another form"),
        ("weights_config.json", lambda about: about["config"]["0.weight"]["tensor_meta"].update(dtype=5), "type 5"),
    ],
)  # fmt: skip
def test_files_that_were_changed(saved: Path, tmp_path: Path, name: str, change: Callable, message: str) -> None:
    with pytest.raises(otr.OtrError, match=message):
        otr.from_torch(changed(saved, tmp_path / "changed.pt2", name, change))


def test_what_is_no_export(saved: Path, tmp_path: Path) -> None:
    content = saved.read_bytes()
    for length in range(0, len(content), 997):
        (tmp_path / "cut.pt2").write_bytes(content[:length])
        with pytest.raises(otr.ArtefactError):
            otr.from_torch(tmp_path / "cut.pt2")
    with pytest.raises(otr.ArtefactError, match="does not exist"):
        otr.from_torch(tmp_path / "nosuch.pt2")
    torch.save(sequential(nn.ReLU()).state_dict(), tmp_path / "weights.pt2")
    with pytest.raises(otr.ArtefactError, match=r"holds no models/model.json.*torch 2.9 or newer: torch.export.save"):
        otr.from_torch(tmp_path / "weights.pt2")


def test_numbers_of_other_types() -> None:
    """Half and bfloat16 weights, and tied ones, which share their bytes."""
    for kind in (torch.float64, torch.float16, torch.bfloat16):
        module = sequential(nn.ReLU()).to(kind)
        network = otr.from_torch(exported(module, states=STATES[:1].to(kind)))
        np.testing.assert_array_equal(network.weights[0], module[0].weight.detach().double().numpy())
    tied = nn.Sequential(nn.Linear(4, 4), nn.ReLU(), nn.Linear(4, 4))
    tied[2].weight = tied[0].weight
    assert_answers(otr.from_torch(exported(tied)), tied)


def test_a_constant_argument_and_a_layer_that_cannot_be_read_are_named() -> None:
    module = Policy(lambda m, x: m.two(torch.relu(m.one(x))))
    module.forward = lambda x, factor: factor * module.two(torch.relu(module.one(x)))  # type: ignore[method-assign]
    with pytest.raises(otr.InvalidNetworkError, match="besides the states; export the module with only these"):
        otr.from_torch(torch.export.export(module, (STATES[:1], 2.0)))
    normed = nn.Sequential(nn.Linear(4, 5), nn.LayerNorm(5), nn.ReLU(), nn.Linear(5, 2))
    with pytest.raises(otr.InvalidNetworkError, match=r"\(layer_norm\) is not affine"):
        otr.from_torch(exported(normed))
