"""certify=true and simplify=true on committed runs: what they add, what otr-verify accepts, and what it refuses."""

import json

import numpy as np
import pytest

import otr
from pipelines.cli.overrides import box_spelt_out
from pipelines.config.stages import CertificationConfig, PruneConfig
from pipelines.engine.store import read_json, write_files
from pipelines.play.actor_files import actor_files, load_actor
from pipelines.play.spaces import state_limits
from pipelines.runs.result import proof_line
from pipelines.stages.certify import CERTIFY, certify
from tests.committed import RESULTS, copy_run
from tests.pipelines.conftest import HOPPER, PENDULUM

PENDULUM_RUN = "runs/pendulum/otr/depth-6/quick/seed-0"
CAR_RUN = "runs/mountaincar/otr/depth-1/quick/seed-0"


@pytest.fixture
def results(tmp_path):
    """Return a results folder with the committed runs of the pendulum and the car, without their extra stages."""
    for run in (PENDULUM_RUN, CAR_RUN):
        copy_run(run.removeprefix("runs/"), tmp_path / "results" / run, "certify", "simplify")
    return tmp_path / "results"


def certified(command, results, *words):
    done = command("run", "env=pendulum", "depth=6", "budget=quick", "certify=true", f"results_dir={results}", *words)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def test_a_finished_run_gets_a_certificate_and_nothing_else_is_done_again(command, results):
    run = results / PENDULUM_RUN
    before = {path: path.read_bytes() for path in run.glob("*/*") if path.suffix in (".npz", ".csv", ".json")}
    done = certified(command, results)
    assert "certify: " in done.stdout and "train: done before" in done.stdout
    assert "the minimal tree, of 30 leaves, is exactly the network on the environment's box of states" in done.stdout
    assert all(path.read_bytes() == content for path, content in before.items())
    report = json.loads((run / "certify/report.json").read_text())
    assert (report["certified"], report["n_leaves"]) == (True, 30)
    assert 0 <= report["max_error"] < 1e-9
    assert set(report["seconds"]) == {"minimal_tree", "certify", "verify"}
    assert report["low"] == [-1.0, -1.0, -8.0] and report["high"] == [1.0, 1.0, 8.0]
    assert json.loads((run / "summary.json").read_text())["certify"] == report
    tree, network = otr.load(run / "certify/tree"), load_actor(run / "train")
    X = np.random.default_rng(0).uniform(*state_limits(PENDULUM), (5000, 3))
    np.testing.assert_allclose(tree.forward(X), network.forward(X), atol=report["max_error"] + 1e-12)
    again = certified(command, results)
    assert "certify: done before" in again.stdout


def test_otr_verify_accepts_what_is_true_and_names_the_leaf_of_what_is_not(command, results, tmp_path):
    certified(command, results)
    folder, word = results / PENDULUM_RUN / "certify", f"run={results / PENDULUM_RUN}"
    done = command("verify", word)
    assert done.returncode == 0 and done.stdout.startswith("verified: 30 leaves, 30 regions"), done.stderr
    assert done.stdout.endswith("at every real point (in rational arithmetic), tree and network are equal\n")
    tree = otr.load(folder / "tree")
    M = tree.M.copy()
    M[7, 0, 1] += 1e-3
    arrays = (tree.children_left, tree.children_right, tree.P, tree.v, M, tree.c)
    otr.save(otr.ObliqueTree(*arrays, head=tree.head), tmp_path / "tampered")
    refused = command("verify", word, f"tree={tmp_path / 'tampered.json'}")
    assert refused.returncode == 1 and "leaf 7:" in refused.stderr, refused.stderr
    lines = (
        (folder / "certificate.json").read_text().replace('"leaf": 12, "outcomes": "0', '"leaf": 12, "outcomes": "1')
    )
    lines = lines.replace('"leaf": 12, "outcomes": "10', '"leaf": 12, "outcomes": "00')
    (tmp_path / "lie.json").write_text(lines)
    refused = command("verify", word, f"certificate={tmp_path / 'lie.json'}")
    assert refused.returncode == 1 and "leaf 12:" in refused.stderr, refused.stderr
    lie = json.loads((folder / "certificate.json").read_text())
    lie["domain"] = {"low": [0.9, 0.09, 0.09], "high": [0.91, 0.1, 0.1]}
    (tmp_path / "smaller.json").write_text(json.dumps(lie))
    refused = command("verify", word, f"certificate={tmp_path / 'smaller.json'}")
    assert refused.returncode == 1 and "smaller than the environment's box of states, cos_angle in -1" in refused.stderr
    other = results / CAR_RUN / "train"
    refused = command("verify", word, f"actor={other}")
    assert refused.returncode == 1 and "the domain 3 inputs" in refused.stderr


def test_a_run_without_a_certificate_is_told(command, results):
    done = command("verify", f"run={results / PENDULUM_RUN}")
    assert done.returncode == 1 and f"budget=quick seed=0 results_dir={results} certify=true\n" in done.stderr
    missing = command("verify", f"run={results / 'runs/pendulum/otr/depth-6/quick/seed-9'}")
    assert missing.returncode == 2 and "there is no such folder" in missing.stderr
    assert command("verify").returncode == 2
    imitated = command("run", "env=pendulum", "method=viper", "certify=true", f"results_dir={results}")
    assert imitated.returncode == 2 and "method=viper stands for no network" in imitated.stderr


def test_a_tree_that_is_too_large_is_told_and_fails_nothing(command, results):
    done = certified(command, results, "certification.max_leaves=5")
    assert "angle_rate in -8..8: the limit of 5 regions was met" in done.stdout
    path = next(results.glob("runs/pendulum/otr/depth-6/quick/seed-0~*/certify/report.json"))
    assert json.loads(path.read_text())["certified"] is False
    for words in (("verify",), ("export", "tree=minimal", "format=text")):
        asked = command(*words, f"run={path.parents[1]}")
        assert asked.returncode == 1 and "as stage certify gave up: the limit of 5 regions was met" in asked.stderr


def test_unbounded_states_are_proved_on_the_box_of_those_visited(tiny, tmp_path):
    assert state_limits(HOPPER) is None
    run = tmp_path / "run"
    copy_run("hopper/otr/depth-6/quick/seed-0", run)
    config = tiny(env=HOPPER, depth=6, prune=PruneConfig(2, None))
    certify({"train": run / "train", "map": run / "map"}, config, tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["domain"] == "the box around the states of 2 episodes" and report["certified"]
    assert report["n_leaves"] <= 64 and all(low < high for low, high in zip(report["low"], report["high"], strict=True))
    certificate = otr.load_certificate(tmp_path / "certificate.json")
    network = load_actor(run / "train")
    assert otr.verify(certificate, otr.load(tmp_path / "tree"), network) < 1e-9


@pytest.mark.parametrize("far", [1.5, 20.0])
def test_a_box_beyond_the_trained_policy_s_is_told(tiny, tmp_path, far):
    network = otr.ReluNetwork([[[1.0, 0.5, 0.2]], [[1.0]]], [[0.0], [0.0]], head=otr.ClipBox(-2, 2))
    own = (np.array([-far, -np.inf, -np.inf]), np.full(3, far))
    (tmp_path / "train").mkdir()
    write_files(actor_files(network.replace(domain=own)), tmp_path / "train")
    certify({"train": tmp_path / "train"}, tiny(env=PENDULUM), tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    is_beyond = far < 8  # the largest rate
    assert report["certified"] and ("network_domain" in report) == is_beyond
    assert ("reaches beyond the one in which the network is the trained policy" in proof_line(report)) == is_beyond
    certify({"polish": tmp_path / "train"}, tiny(env=PENDULUM), tmp_path)  # which was trained on nothing else
    assert "network_domain" not in json.loads((tmp_path / "report.json").read_text())


def test_the_mountain_car_s_program_becomes_one_line(command, results):
    words = ("env=mountaincar", "depth=1", "budget=quick", "simplify=true", f"results_dir={results}", "n_workers=1")
    done = command("run", *words)
    assert done.returncode == 0, done.stderr
    folder = results / CAR_RUN / "simplify"
    report = json.loads((folder / "report.json").read_text())
    program = (folder / "program.txt").read_text()
    assert f"simplified:\n\n{program}" in done.stdout
    assert len(program.split()) <= len(["if", "velocity", "<=", "0", "then", "return", "-1", "else", "return", "1"])
    assert report["n_numbers"] <= 4 < report["n_numbers_before"]
    assert report["return_mean"] > 90 and report["return_mean"] > 0.97 * report["return_mean_before"]
    assert report["n_episodes"] == 1000 and report["n_deciding_episodes"] == 100
    assert (folder / "episodes.csv").read_text().count("\n") == 1001
    simpler = otr.load(folder / "tree")
    assert np.array(simpler.predict([[-0.5, 0.05], [-0.5, -0.05]])).ravel().tolist() == [1.0, -1.0]
    exported = command("export", f"run={results / CAR_RUN}", "format=text", "tree=simplified")
    assert exported.stdout == program


def test_a_bound_on_actions_decides_in_the_return_s_place(command, results):
    words = ("env=mountaincar", "depth=1", "budget=quick", "stages=[simplify]", "simplification.action_bound=0.05",
             f"results_dir={results}", "n_workers=1")  # fmt: skip
    # Another setting of the extra stage alone: the run before it is found, not done again.
    missing = command("run", *words)
    assert missing.returncode == 1 and "prune" in missing.stderr
    done = command("run", *words[:3], "simplify=true", *words[4:])
    assert done.returncode == 0, done.stderr
    (folder,) = results.glob("runs/mountaincar/otr/depth-1/quick/seed-0~*/simplify")
    report = json.loads((folder / "report.json").read_text())
    assert report["mean_difference"] <= 0.05 and report["n_numbers"] < report["n_numbers_before"]
    assert abs(report["return_mean"] - report["return_mean_before"]) < 5


def test_pid_policies_are_proved_exported_and_simplified_in_the_form_that_fits(command, tmp_path):
    run = "runs/pendulum/pid/depth-1/quick/seed-0"
    copy_run(run.removeprefix("runs/"), tmp_path / run, "certify", "simplify")
    words = ("env=pendulum", "method=pid", "budget=quick", "stages=[certify]", f"results_dir={tmp_path}", "n_workers=1")
    assert command("run", *words).returncode == 0
    report = json.loads((tmp_path / run / "certify/report.json").read_text())
    assert report["certified"] and report["n_leaves"] == 2 and len(report["low"]) == 12
    assert command("verify", f"run={tmp_path / run}").returncode == 0
    for word in ("tree=pruned", "tree=compact", "tree=constant_gains"):
        written = command("export", f"run={tmp_path / run}", "format=c", word)
        assert written.returncode == 0 and "P_cos_angle" in written.stdout
    other = command("export", f"run={RESULTS / PENDULUM_RUN}", "format=c", "tree=constant_gains")
    assert other.returncode == 2 and "gains are of method=pid" in other.stderr
    tree = otr.load(tmp_path / run / "prune/tree")
    with pytest.raises(ValueError, match="multiplies outputs"):
        otr.output_range(tree, (-1.0, 1.0))


def test_a_given_box_is_keyed_where_it_is_given_and_is_what_is_proved(command, results, tiny):
    usual = CERTIFY.keyed(tiny())
    boxed = tiny(certification=CertificationConfig(["angle_rate in -1..1"]))
    assert "box" not in usual and CERTIFY.keyed(boxed) == usual | {"box": ["angle_rate in -1..1"]}
    assert "box" not in tiny().settings()["certification"]
    done = certified(command, results, "box=[angle_rate in -1 .. 1.0, sin_angle in 0..0.5]")
    where = "the given box, cos_angle in -1..1, sin_angle in 0..0.5, angle_rate in -1..1"
    assert f"is exactly the network on {where}, by rational arithmetic" in done.stdout
    (run,) = results.glob("runs/pendulum/otr/depth-6/quick/seed-0~*")
    assert read_json(run / "certify/report.json")["low"] == [-1.0, 0.0, -1.0]
    checked = command("verify", f"run={run}")
    assert checked.returncode == 0 and f"on {where}, at every real point" in checked.stdout, checked.stderr
    asked = command("verify", f"run={run}", "range=true")
    assert asked.returncode == 0 and f"at every real point of {where}" in asked.stdout


@pytest.mark.parametrize(
    ("box", "told"),
    [
        ("[angl in -1..1]", "box: angl in -1..1: there is no such state"),
        ("[angle_rate in 1..-1]", "1 is above -1, lower first"),
        ("[angle_rate in 0..1, angle_rate in 0..2]", "which has a side already"),
        ("[angle_rate between 0 and 1]", "a file with a side a line"),
        ("[angle_rate in 0..x]", "give the sides of a box as"),
    ],
)
def test_a_box_that_is_none_is_told(command, tmp_path, box, told):
    done = command("run", "env=pendulum", "budget=smoke", "certify=true", f"box={box}", f"results_dir={tmp_path}")
    assert done.returncode == 2 and told in done.stderr


def test_a_box_from_a_file_is_the_same_box(tmp_path):
    (tmp_path / "box.txt").write_text("# upright\nangle_rate in -1..1\n\ncos_angle in 0.5..1  # and near\n")
    words = (f"box={tmp_path / 'box.txt'}", "box=[angle_rate in -1..1., cos_angle in .5..1]")
    assert len({box_spelt_out(word) for word in words}) == 1
    assert box_spelt_out(words[0]) == "box=['angle_rate in -1..1','cos_angle in 0.5..1']"
