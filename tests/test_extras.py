"""What is not installed with otr itself is named, with the extra that installs it, when it is asked for."""

import json
import pickle
import subprocess
import sys
import zipfile

import pytest

import otr
from otr import control, learners
from otr.extras import naming_the_extra

ASKED = """
import sys
missing = ["gymnasium", "huggingface_hub", "joblib", "matplotlib", "onnx", "skops", "sklearn", "torch"]
sys.modules.update(dict.fromkeys(missing))
import json
import numpy as np
import otr
from otr import control, importers, learners

network = otr.ReluNetwork([np.ones((1, 2))], [np.zeros(1)])
tree = otr.map_network(network)
calls = {
    "otr.from_torch": lambda: otr.from_torch(None),
    "otr.from_sb3": lambda: otr.from_sb3(sys.argv[1]),
    "otr.from_sklearn": lambda: otr.from_sklearn(None),
    "otr.read_policy": lambda: importers.read_policy("policy.skops"),
    "otr.from_hub": lambda: otr.from_hub("org/name"),
    "otr.from_onnx": lambda: otr.from_onnx(b""),
    "otr.rollout": lambda: otr.rollout("CartPole-v1", tree),
    "otr.evaluate": lambda: otr.evaluate("CartPole-v1", tree),
    "otr.to_onnx": lambda: otr.to_onnx(tree),
    "otr.draw_tree": lambda: otr.draw_tree(tree),
    "otr.save_picture": lambda: otr.save_picture(None, "tree.svg"),
}
for package in (control, learners):
    for name in package.__all__:
        calls[f"{package.__name__}.{name}"] = lambda package=package, name=name: getattr(package, name)
errors = {}
for name, call in calls.items():
    try:
        call()
    except otr.MissingExtraError as error:
        errors[name] = str(error)
print(json.dumps(errors))
"""
NUMPY_ALONE = {  # names of otr.control that need nothing else
    "DaggerProgress", "DaggerResult", "DaggerSettings", "Iterate", "NdpsSettings", "StudentFit", "argmax_leaves",
    "constant_gains", "draw_rows", "pid_network", "pid_observation", "pid_observation_names", "run_dagger",
}  # fmt: skip


@pytest.fixture(scope="module")
def errors(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "model.zip"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("data", "{}")
        file.writestr("policy.pth", b"")
    done = subprocess.run([sys.executable, "-c", ASKED, str(path)], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


NEEDS = {
    "torch, learn": ("otr.from_torch", "otr.from_sb3", "otr.control.SoftTree"),
    "scikit-learn, learn": ("otr.from_sklearn", "otr.learners.CARTClassifier"),
    "skops, learn": ("otr.read_policy",),
    "onnx, onnx": ("otr.from_onnx", "otr.to_onnx"),
    "huggingface_hub, hub": ("otr.from_hub",),
    "gymnasium, run": ("otr.rollout", "otr.evaluate"),
    "matplotlib, plots": ("otr.draw_tree", "otr.save_picture"),
}


def test_the_error_names_package_and_extra_for_every_learner_and_imitator(errors):
    for needed, names in NEEDS.items():
        package, extra = needed.split(", ")
        for name in names:
            assert errors[name] == f"{name} needs {package}, which is not installed: pip install 'otr[{extra}]'"
    of_learners = {name for name in errors if name.startswith("otr.learners.")}
    assert of_learners == {f"otr.learners.{name}" for name in learners.__all__}
    needing = {name.removeprefix("otr.control.") for name in errors if name.startswith("otr.control.")}
    assert needing == set(control.__all__) - NUMPY_ALONE


def test_the_error_is_an_import_error_and_can_be_pickled():
    with pytest.raises(ImportError) as raised, naming_the_extra("a test"):
        raise ModuleNotFoundError("No module named 'torch'", name="torch.nn")
    copy = pickle.loads(pickle.dumps(raised.value))
    assert (type(copy), str(copy)) == (otr.MissingExtraError, str(raised.value))
    with pytest.raises(ModuleNotFoundError, match="otr") as raised, naming_the_extra("a test"):
        raise ModuleNotFoundError("No module named 'otr.growth'", name="otr.growth")  # which no extra brings
    assert not isinstance(raised.value, otr.MissingExtraError)


def test_commands_name_the_extra_that_brings_them():
    """With numpy and scipy alone: a message and exit code 1, no traceback."""
    names = ("run", "plan", "fit", "tabulate", "export", "verify", "data")
    code = (
        "import contextlib, sys\n"
        "missing = ['hydra', 'omegaconf', 'rich', 'pandas', 'gymnasium', 'filelock', 'safetensors']\n"
        "sys.modules.update(dict.fromkeys(missing)); from pipelines import cli; names, sys.argv = sys.argv[1:], ['x']\n"
        "for name in names:\n"
        "    try: getattr(cli, name)()\n"
        "    except SystemExit as ended: print(ended.code)"
    )
    done = subprocess.run([sys.executable, "-c", code, *names], capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()) == (0, ["1"] * len(names)), done.stderr
    for name, line in zip(names, done.stderr.splitlines(), strict=True):
        assert line.startswith(f"otr-{name}: ") and line.endswith("pip install 'otr[run]'")
