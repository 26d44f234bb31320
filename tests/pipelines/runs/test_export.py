"""otr-export: committed runs as programs, and what is told where there is nothing to export."""

import functools
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

import otr
from pipelines.play.actor_files import load_actor
from pipelines.runs.export import FORMATS
from pipelines.runs.finished_run import run_command
from tests.committed import RESULTS, committed_tree, copy_run

HOPPER, LANDER = "hopper/otr/depth-6/quick/seed-0", "lunarlander/otr/depth-2/thesis/seed-0"


@pytest.fixture
def export(command, monkeypatch):
    """Return what exports a committed run."""
    monkeypatch.setenv("OTR_RESULTS_DIR", str(RESULTS))
    return functools.partial(command, "export")


def test_the_command_from_another_folder(tmp_path):
    program = [sys.executable, "-c", "from pipelines.cli import export; export()"]
    done = subprocess.run([*program, f"run={RESULTS / 'runs' / LANDER}", "format=text"], cwd=tmp_path,
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0, done.stderr
    copy_run(LANDER, tmp_path / "run")
    assert done.stdout == (tmp_path / "run/prune/program.txt").read_text()
    help_text = subprocess.run([*program, "--help"], capture_output=True, text=True, check=True).stdout
    assert all(name in help_text for name in FORMATS)


def test_files_of_every_format(export, tmp_path):
    for name, kind in FORMATS.items():
        done = export(f"run={HOPPER}", f"format={name}", f"out={tmp_path}")
        assert done.returncode == 0, done.stderr
        assert done.stdout == f"{tmp_path}/policy{kind.suffix}\n"
    copy_run(HOPPER, tmp_path / "run")
    assert (tmp_path / "policy.txt").read_text() == (tmp_path / "run/prune/program.txt").read_text()
    assert json.loads((tmp_path / "policy.json").read_text())["outputs"] == ["thigh", "leg", "foot"]
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    states = np.random.default_rng(0).normal(size=(50, 11))
    tree = committed_tree(HOPPER)
    np.testing.assert_allclose(session.run(None, {"x": states})[0], tree.predict(states), atol=1e-12)
    for suffix in (".ino", ".st", ".tex", ".dot"):
        assert "foot" in (tmp_path / f"policy{suffix}").read_text()


def test_fixed_point(export, tmp_path):
    done = export(f"run={LANDER}", "format=micropython", "bits=12", "name=pilot")
    assert done.returncode == 0 and done.stderr.startswith("12 bits: the label is the tree's, farther than 0.0")
    scope, tree = {}, committed_tree(LANDER)
    exec(done.stdout, scope)
    assert "angle_rate = 0.0" in done.stdout
    box = otr.Domain([-2.5, -2.5, -10, -10, -2 * np.pi, -10, 0, 0], [2.5, 2.5, 10, 10, 2 * np.pi, 10, 1, 1])
    fixed = otr.to_fixed_point(tree, box, 12)
    Q = fixed.to_integers(np.random.default_rng(0).uniform(box.low, box.high, size=(200, 8)))
    agree = fixed.predict_integers(Q) == [scope["pilot"](q) for q in Q.tolist()]
    assert agree.mean() > 0.99  # the box is the environment's in float32
    narrow = export(f"run={HOPPER}", "format=c_fixed", "box=[z in 0.7..1.5]")
    assert narrow.returncode == 2 and "has no limits for some states" in narrow.stderr
    hopper = export(f"run={HOPPER}", "format=c_fixed", f"out={tmp_path}/hopper.c")
    assert hopper.stderr.startswith("16 bits: no action is off by more than 0.0") and "POLICY_TEST" in (
        tmp_path / "hopper.c").read_text()  # fmt: skip
    bounded = export("run=pendulum/otr/depth-6/quick/seed-0", "format=c", "dtype=float")
    assert "by rounding to float, no action changes by more than" in bounded.stderr
    assert "For x in [-1, 1], [-1, 1], [-8, 8]: by rounding to float" in bounded.stdout
    refused = export(f"run={HOPPER}", "format=c", "bits=8")
    assert refused.returncode == 2 and "format=c has none; these have: c_fixed, arduino" in refused.stderr


def test_full_and_compact(export, tmp_path):
    network = load_actor(RESULTS / "runs" / HOPPER / "train")
    names = json.loads(export(f"run={HOPPER}", "format=json", "tree=full").stdout)
    assert len(names["leaves"]) == 64
    compact = export(f"run={HOPPER}", "format=c", "tree=compact", "dtype=float", f"out={tmp_path}/new/pilot.c")
    assert compact.stdout == f"{tmp_path}/new/pilot.c\n"
    expected = otr.to_c(network, dtype="float", feature_names=names["features"], output_names=names["outputs"])
    assert (tmp_path / "new/pilot.c").read_text() == expected
    polished = load_actor(RESULTS / "runs" / LANDER / "polish")
    names = json.loads(export(f"run={LANDER}", "format=json", "tree=polished").stdout)
    expected = otr.to_c(polished, feature_names=names["features"], output_names=names["outputs"])
    assert export(f"run={LANDER}", "format=c", "tree=polished_compact").stdout == expected
    deep = "pendulum/otr/depth-32/quick/seed-0"
    assert "A network of 32 hidden neurons" in export(f"run={deep}", "format=c", "tree=full").stdout


def test_a_program_without_a_run(export, tmp_path):
    path = tmp_path / "by hand~1.txt"
    path.write_text("if velocity <= 0: -3 else: 2 position\n")
    done = export("env=mountaincar", f"program={path}", "format=python")
    assert done.returncode == 0, done.stderr
    scope = {}
    exec(done.stdout, scope)
    assert [scope["policy"](state) for state in ([0.25, 0.1], [0.25, -0.1], [9.0, 0.1])] == [[0.5], [-1.0], [1.0]]
    lander = export("env=LunarLander-v3", "program=mountaincar", "format=c")
    assert lander.returncode == 2 and "unknown name 'position'" in lander.stderr
    own = export("env=Acrobot-v1", f"program={path}", "format=c")
    assert own.returncode == 2 and f"{path}:1:4: unknown name 'velocity'" in own.stderr


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        ((), 2, "which run? Add run=FOLDER"),
        (("program=mountaincar", "format=c"), 2, "over which environment's names? Add env=NAME"),
        (("program=mountaincar", f"run={HOPPER}", "format=c"), 2, "are two policies; leave one of them out"),
        (("env=hopper", f"run={HOPPER}", "format=c"), 2, "a run has its own environment; leave env=hopper out"),
        (("env=mountaincar", "program=mountaincar", "tree=full", "format=c"), 2, "leave tree=full out"),
        ((f"run={HOPPER}",), 2, "which format? Add format=NAME with one of: text, python, c"),
        ((f"run={HOPPER}", "format=structuredtext"), 2, "no such format. Did you mean structured_text?"),
        ((f"run={HOPPER}", "format=c", "tree=prunde"), 2, "no such tree. Did you mean pruned?"),
        ((f"run={HOPPER}", "fromat=c"), 2, "Did you mean format?"),
        ((f"run={HOPPER}", "format=onnx"), 2, "add out=policy.onnx"),
        ((f"run={HOPPER}", "format=c", "precision=3"), 2, "format=c has none; these have: text, latex, dot"),
        ((f"run={HOPPER}", "format=text", "precision=0"), 2, "format=text: precision is 0"),
        ((f"run={HOPPER}", "format=c", "dtype=half"), 2, "dtype=half: use one of double, float"),
        ((f"run={HOPPER}", "format=c", "name=int"), 2, "cannot be the name of a C function"),
        ((f"run={HOPPER}", "format=python", "tree=compact"), 2, "only format=c writes the network itself"),
        (("run=lunarlander/viper/depth-6/quick/seed-0", "format=c", "tree=compact"), 2, "stands for no network"),
        (("run=pendulum/otr/depth-32/quick/seed-0", "format=json", "tree=full"), 2, "4,294,967,296 leaves"),
        (("run=hopper/otr/depth-6/quick/seed-77", "format=c"), 2, "otr-run env=hopper depth=6 budget=quick seed=77"),
        (
            (f"run={HOPPER}", "format=c", "out=/dev/null/x.c"),
            1,
            "out=/dev/null/x.c: cannot be written (",
        ),
        (("run=hoper/otr/depth-6/quick/seed-0", "format=c"), 2, f"Did you mean {HOPPER}"),
    ],
)
def test_what_cannot_be_exported_is_told(export, words, code, told):
    done = export(*words)
    assert (done.returncode, done.stdout) == (code, "")
    assert told in done.stderr and "Traceback" not in done.stderr


def test_an_unfinished_or_damaged_run_is_told(export, tmp_path):
    run = tmp_path / "runs" / LANDER
    copy_run(LANDER, run)
    command = "Run: otr-run env=lunarlander depth=2 budget=thesis seed=0"
    (run / "prune/tree.npz").write_bytes(b"")
    assert "tree.npz is not what was written" in export(f"run={run}", "format=c").stderr
    shutil.rmtree(run / "prune")
    done = export(f"run={run}", "format=c")
    assert (
        done.returncode == 1
        and f"stage prune, which makes tree=pruned, is not finished there\n{command}" in done.stderr
    )
    assert export(f"run={run}", "format=c", "tree=full").returncode == 0
    (run / "config.yaml").unlink()
    assert f"did not come to its end\n{command}" in export(f"run={run}", "format=c").stderr
    (run / "config.yaml").write_text("junk: [\n")
    assert "config.yaml" in (done := export(f"run={run}", "format=c")).stderr and "fit" not in done.stderr
    (run / "config.yaml").write_bytes(b"\xff\xfe junk")
    assert f"{run}/config.yaml cannot be read" in export(f"run={run}", "format=c").stderr
    (run / "config.yaml").write_text("data:\n  name: bace\n")
    assert "is a fit of otr-fit" in export(f"run={run}", "format=c").stderr


def test_a_run_with_a_digest_is_told_the_command_that_made_it(export, tmp_path):
    run = tmp_path / "runs" / f"{LANDER}~12345678"
    copy_run(LANDER, run)
    path = run / "train/manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"command": "otr-run env=lunarlander model=a.zip"}))
    done = export(f"run={run}", "format=c", "tree=simplified")
    assert done.returncode == 1
    place = f"results_dir={tmp_path}"
    assert f"not finished there\nRun: otr-run env=lunarlander model=a.zip {place} simplify=true" in done.stderr


@pytest.mark.parametrize("name", ["moved", "a/b/c/d/e/moved"])
def test_a_run_that_was_moved_is_exported_and_its_command_names_no_folder_of_results(export, command, tmp_path, name):
    run = tmp_path / name
    copy_run(LANDER, run)
    shutil.rmtree(run / "certify")
    assert export(f"run={run}", "format=text").returncode == 0
    for done in (export(f"run={run}", "format=c", "tree=simplified"), command("verify", f"run={run}")):
        assert done.returncode == 1 and "Run: otr-run " in done.stderr and "results_dir" not in done.stderr
        assert "IndexError" not in done.stderr and done.stderr.count("certify=true") <= 1, done.stderr


@pytest.mark.parametrize(
    ("folder", "command"),
    [
        ("results/runs/ant/cdt/depth-3-3/quick/seed-2", "otr-run env=ant 'depth=[3,3]' method=cdt budget=quick seed=2"),
        ("results/runs/ant/otr/depth-6/thesis-fleet/seed-0",
         "otr-run env=ant depth=6 budget=thesis trainer=fleet seed=0"),
        ("results/runs/ant/linear/depth-0/quick-ars/seed-1",
         "otr-run env=ant depth=0 method=linear budget=quick algo=ars seed=1"),
        ("results/runs/ant/otr/depth-6/quick/seed-0~5636a33a",
         "otr-run env=ant depth=6 budget=quick seed=0 and the settings that made the digest ~5636a33a"),
        ("mine/runs/ant/otr/depth-6/quick/seed-0", "otr-run env=ant depth=6 budget=quick seed=0 results_dir=mine"),
        ("/other/runs/ant/otr/depth-6/quick/seed-0",
         "otr-run env=ant depth=6 budget=quick seed=0 results_dir=/other"),
        ("results/tables", None),
        ("runs/bace/otr/seed-0/fit/x", None),
    ],
)  # fmt: skip
def test_the_command_that_makes_a_folder(folder, command):
    assert run_command(Path(folder)) == command
