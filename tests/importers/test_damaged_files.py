"""Files that were changed somewhere are read or refused: nothing but the library's own errors comes out."""

import copy
import io
import json
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skops.io
import torch
from onnx import TensorProto, helper
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from stable_baselines3 import PPO, SAC
from torch import nn

import otr
from otr.importers import read_policy
from tests.importers.test_importers import FourActions, build
from tests.importers.test_stored_layers import nnet
from tests.importers.test_torch_export import exported, written

torch.set_num_threads(1)

VALUES = (None, True, 0, -1, 3, 2.5, 1e400, 10**30, "", "x", "3", [], {}, [[1]], ["x"], {"x": 1})
SHAPES = ((), (0,), (1,), (3,), (0, 3), (2, 3), (4, 4), (1, 1, 1), (2, 0))
PARTS = ("policy_class", "policy_kwargs", "observation_space", "action_space", "use_sde", "_last_obs")


def zip_of(algorithm: type, path: Path) -> Path:
    model = build(algorithm, FourActions() if algorithm is PPO else "Pendulum-v1", {"vf": [8], "qf": [8]}, [4, 3])
    model._last_obs = np.zeros((1, 3), np.float32)
    model.save(path / "policy.zip")
    return path / "policy.zip"


def skops_file(path: Path) -> Path:
    X = np.random.default_rng(0).normal(size=(60, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitted = make_pipeline(StandardScaler(), MLPClassifier((4,), max_iter=3)).fit(X, X[:, 0] > 0)
    fitted[-1].classes_ = np.array([0, 1])
    skops.io.dump(fitted, path / "policy.skops")
    return path / "policy.skops"


def torch_export(path: Path) -> Path:
    module = nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 2), nn.Tanh())
    return written(exported(module, states=torch.zeros(1, 3)), path / "policy.pt2")


def saved(path: Path) -> Path:
    otr.save(otr.PatternTree(otr.ReluNetwork([np.eye(3), np.ones((2, 3))], [np.ones(3), np.ones(2)])), path / "policy")
    return path / "policy.json"


def nnet_file(path: Path) -> Path:
    return nnet(path / "policy.nnet")


def changed_numbers(content: bytes, rng: np.random.Generator) -> bytes:
    rows = [line.split(b",") for line in content.splitlines()]
    row = rows[2 + rng.integers(min(len(rows) - 2, 9))]
    row[rng.integers(len(row))] = (b"", b"0", b"-1", b"3,3", b"1e99", b"nan", b"x", b"999999999")[rng.integers(8)]
    return b"\n".join(b",".join(row) for row in rows)


def changed_json(value: Any, rng: np.random.Generator) -> Any:
    """Return JSON with one value somewhere replaced, taken out or doubled."""
    value = copy.deepcopy(value)
    place = value
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        if not keys:
            return value
        key = keys[rng.integers(len(keys))]
        if isinstance(place[key], dict | list) and place[key] and rng.random() < 0.8:
            place = place[key]
            continue
        kind = rng.random()
        if kind < 0.25:
            del place[key]
        elif kind < 0.35 and isinstance(place, list):
            place.append(place[key])
        else:
            place[key] = VALUES[rng.integers(len(VALUES))]
        return value


def changed_text(content: bytes, rng: np.random.Generator) -> bytes:
    return json.dumps(changed_json(json.loads(content), rng)).encode()


def changed_data(content: bytes, rng: np.random.Generator) -> bytes:
    """Change what is read of a zip's `data`."""
    data = json.loads(content)
    return json.dumps({**data, **changed_json({name: data.get(name) for name in PARTS}, rng)}).encode()


def changed_tensors(content: bytes, rng: np.random.Generator) -> bytes:
    tensors = torch.load(io.BytesIO(content), weights_only=True)
    name = list(tensors)[rng.integers(len(tensors))]
    kind = (torch.float32, torch.float64, torch.int64, torch.complex64)[rng.integers(4) if rng.random() < 0.3 else 0]
    tensor = torch.zeros(SHAPES[rng.integers(len(SHAPES))], dtype=kind)
    if rng.random() < 0.2:
        tensors[name + ".x"] = tensors.pop(name)
    else:
        tensors[name] = tensors[name].T.clone() if rng.random() < 0.1 else tensor
    packed = io.BytesIO()
    torch.save(tensors, packed)
    return packed.getvalue()


FILES: dict[str, tuple[Callable[[Path], Path], str, Callable[[bytes, np.random.Generator], bytes]]] = {
    "the data of a zip": (lambda path: zip_of(PPO, path), "data", changed_data),
    "the data of a zip with a box": (lambda path: zip_of(SAC, path), "data", changed_data),
    "the tensors of a zip": (lambda path: zip_of(PPO, path), "policy.pth", changed_tensors),
    "the tensors of a zip with a box": (lambda path: zip_of(SAC, path), "policy.pth", changed_tensors),
    "a skops schema": (skops_file, "schema.json", changed_text),
    "the graph of a torch export": (torch_export, "models/model.json", changed_text),
    "the tensors of a torch export": (torch_export, "data/weights/model_weights_config.json", changed_text),
    "a saved network": (saved, "", changed_text),
    "a file of the format nnet": (nnet_file, "", changed_numbers),
}


def with_changes(path: Path, member: str, change: Callable, rng: np.random.Generator) -> bytes:
    if not member:
        return change(path.read_bytes(), rng)
    changed = io.BytesIO()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(changed, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            new.writestr(name, change(content, rng) if name.endswith(member) else content)
    return changed.getvalue()


@pytest.mark.parametrize("n_changes", [60, pytest.param(600, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FILES)
@pytest.mark.filterwarnings("ignore")
def test_a_changed_file_is_read_or_refused(tmp_path: Path, name: str, n_changes: int) -> None:
    make, member, change = FILES[name]
    path = make(tmp_path)
    whole, rng, n_refused = path.read_bytes(), np.random.default_rng(n_changes), 0
    assert read_policy(path).forward(np.zeros(3)).ndim == 1
    for _ in range(n_changes):
        path.write_bytes(whole)
        path.write_bytes(with_changes(path, member, change, rng))
        try:
            policy = read_policy(path)
            policy.predict(np.zeros(policy.n_inputs))
        except otr.OtrError as error:
            assert str(error)
            n_refused += 1
        if path.suffix == ".zip":
            with suppress(otr.OtrError):
                otr.from_sb3(path, action_low=[-1.0], action_high=[1.0])
    assert n_refused > 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data["observation_space"].update(_shape=3), "policy.zip cannot be read .TypeError: .*damaged"),
        (lambda data: data["observation_space"].update(_shape=[10**4000, 10**4000]), "policy.zip cannot be read"),
        (lambda data: data.update(policy_class={"__module__": None}), "the policy's class is from None"),
    ],
)
def test_a_zip_of_another_form_says_that_it_is_damaged(tmp_path: Path, change: Callable, message: str) -> None:
    path = zip_of(PPO, tmp_path)

    def changed(content: bytes, _: np.random.Generator) -> bytes:
        data = json.loads(content)
        change(data)
        return json.dumps(data).encode()

    path.write_bytes(with_changes(path, "data", changed, np.random.default_rng(0)))
    for read in (read_policy, otr.from_sb3):
        with pytest.raises((otr.ArtefactError, otr.InvalidNetworkError), match=message):
            read(path)


def onnx_of(n_inputs: int) -> bytes:
    nodes = [helper.make_node("Sub", ["x", "one"], ["a"]), helper.make_node("Mul", ["a", "one"], ["y"])]
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", n_inputs]) for name in "xy"]
    one = helper.make_tensor("one", TensorProto.FLOAT, [], [2.0])
    graph = helper.make_graph(nodes, "policy", values[:1], values[1:], [one])
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return made.SerializeToString()


def test_a_small_file_of_many_wide_values_takes_little_memory() -> None:
    names = ["x", *(f"v{k}" for k in range(200)), "y"]
    nodes = [helper.make_node("Identity", [a], [b]) for a, b in pairwise(names)]
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", 2**17]) for name in "xy"]
    graph = helper.make_graph(nodes, "policy", values[:1], values[1:])
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    with pytest.raises(otr.InvalidNetworkError, match="is where the values of all nodes have 70,778,880 numbers"):
        otr.from_onnx(made)


class Shifted(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x - 1.5) * 2.0


def export_of(n_inputs: int, path: Path) -> bytes:
    whole = written(exported(Shifted(), states=torch.zeros(1, 7)), path)
    text = lambda content, _: content.replace(b'"as_int": 7', b'"as_int": %d' % n_inputs)  # noqa: E731
    return with_changes(whole, "models/model.json", text, np.random.default_rng(0))


@pytest.mark.parametrize("suffix", [".onnx", ".pt2"])
def test_a_small_file_that_declares_many_inputs_takes_little_memory(tmp_path: Path, suffix: str) -> None:
    n_inputs, path = 30_000_000, tmp_path / f"policy{suffix}"
    path.write_bytes(onnx_of(n_inputs) if suffix == ".onnx" else export_of(n_inputs, path))
    tracemalloc.start()
    try:
        for read in (read_policy, otr.from_onnx if suffix == ".onnx" else otr.from_torch):
            with pytest.raises(otr.InvalidNetworkError):
                read(path)
        assert tracemalloc.get_traced_memory()[1] < 2**26
    finally:
        tracemalloc.stop()
