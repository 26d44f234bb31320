"""Programs as policies: from a file, or the shipped ones, to the summary of a run."""

import json

import numpy as np
import pytest

from pipelines.cli.overrides import with_path_quoted
from pipelines.cli.runs import RUN
from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.stages.parse import policy_tree, read_program, shipped_programs
from tests.pipelines.conftest import PENDULUM, otr_command, otr_succeeds

MOUNTAIN_CAR = EnvConfig(
    "mountaincar", "mountaincar", "MountainCarContinuous-v0", {}, ["position", "velocity"], ["force"]
)
LANDER = EnvConfig(
    "lunarlander", "lunarlander", "LunarLander-v3", {},
    ["x", "y", "x_velocity", "y_velocity", "angle", "angle_rate", "left_contact", "right_contact"],
    ["none", "left_engine", "main_engine", "right_engine"],
)  # fmt: skip
DESCENT = """\
# Slow the fall, keep upright, and be still on the ground.
tilt = 0.5 x + x_velocity - angle
if left_contact == 1 and right_contact == 1 then none
else if y_velocity < -0.2 then main_engine
else if tilt > 0.1 then return left_engine
else if tilt < -0.1 then return right_engine
else none
"""


def jobs(*words):
    """Return the jobs of words, as otr-run makes them."""
    multirun = "-m" in words
    given = [with_path_quoted(word) for word in words if word != "-m"]
    return RUN.jobs(RUN.expand(given, multirun))


@pytest.mark.parametrize(("name", "published"), [("mountaincar", 92.8), ("mountaincar_simplified", 92.2)])
def test_the_programs_of_figure_4_2_return_what_the_thesis_says(tmp_path, name, published):
    words = ("env=mountaincar", f"program={name}", "prune.n_episodes=1", "n_workers=1")
    done = otr_succeeds("otr-run", *words, cwd=tmp_path)
    (run_dir,) = tmp_path.glob("results/runs/mountaincar/program/depth-1/standard/seed-0~*")
    summary = json.loads((run_dir / "summary.json").read_text())
    assert abs(summary["return_mean"] - published) < 1
    assert (summary["n_episodes"], summary["n_leaves"], summary["depth"]) == (1_000, 2, 1)
    assert list(summary["policies"]) == ["tree", "pruned_tree"]
    assert (summary["program"], summary["algorithm"], summary["trainer"]) == (name, "none", "none")
    assert (run_dir / "parse/source.txt").read_text() == read_program(name, MOUNTAIN_CAR)
    for told in (f"depth 1, program {name}, seed 0", "return clip(", "2 leaves reached"):
        assert told in done.stdout


@pytest.fixture(scope="module")
def landed(tmp_path_factory):
    """A smoke run of a program for the lander, and what it printed."""
    folder = tmp_path_factory.mktemp("landed")
    (folder / "descent.txt").write_text(DESCENT)
    words = ("env=lunarlander", "program=descent.txt", "budget=smoke", "n_workers=1", "tracking=tensorboard")
    done = otr_succeeds("otr-run", *words, cwd=folder)
    return folder, words, done.stdout


def test_a_program_of_labels_is_a_run_like_others(landed):
    folder, words, printed = landed
    assert "return main_engine" in printed and "does not work" not in printed
    again = otr_command("otr-run", *words, cwd=folder)
    assert again.stdout.count("done before") == 3
    plan = otr_command("otr-plan", "-m", *words[:1], "program=descent.txt,other.txt", *words[2:], cwd=folder)
    assert plan.returncode == 2 and "other.txt: there is no such file" in plan.stderr
    (folder / "other.txt").write_text(DESCENT.replace("-0.2", "-0.3"))
    plan = otr_command(
        "otr-plan", "-m", *words[:1], "program=descent.txt,other.txt", *words[2:], cwd=folder, COLUMNS="200"
    )
    assert [line.split(maxsplit=1)[1].strip() for line in plan.stdout.splitlines() if "runs/" in line] == [
        "skip", "run parse, prune, evaluate",
    ]  # fmt: skip


def test_tables_leave_programs_out_and_play_them_again(landed):
    folder, _, _ = landed
    done = otr_succeeds("otr-tabulate", "table=4.1", "evaluate=true", cwd=folder)
    assert done.stdout.count("2 episodes played again, as recorded") == 2
    assert "rogram" not in (folder / "results/tables/table_4_1.md").read_text()


def test_a_program_that_is_none_is_told_with_its_place(tmp_path):
    (tmp_path / "slip.txt").write_text("if velocity <= 0 then\n    return -1\nelse\n    return positon\n")
    done = otr_command("otr-run", "env=mountaincar", "program=slip.txt", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "otr-run: slip.txt:4:12: unknown name 'positon'. Did you mean position?\n"
        "        return positon\n"
        "               ^\n"
    )
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("program=montaincar",), "Did you mean mountaincar"),
        (("program=no/such.txt",), "program=no/such.txt: there is no such file"),
        (("program=a folder/x~1.txt",), "program=a folder/x~1.txt: there is no such file"),
        (("program=.",), r"program=\. cannot be read"),
        (("method=program",), "method=program: which program"),
        (("program=",), "method=program: which program"),
        (("program=mountaincar", "method=viper"), "not by method=viper; leave one of them out"),
        (("program=mountaincar", "depth=3"), "leave depth=3 out"),
        (("program=mountaincar", "stages=[train]"), "no stage 'train'; it has parse, prune, evaluate"),
        (("pogram=mountaincar",), "Did you mean program"),
    ],
)
def test_words_that_are_refused(words, told):
    with pytest.raises(ConfigError, match=told):
        jobs("env=mountaincar", *words)


def test_a_run_is_named_by_what_its_program_says(tmp_path):
    (tmp_path / "one.txt").write_text("return velocity")
    (tmp_path / "same~1 .txt").write_text("return velocity")
    (tmp_path / "other.txt").write_text("return max(velocity, position)")
    one, same, other = (
        jobs("env=mountaincar", f"program={tmp_path / name}")[0] for name in ("one.txt", "same~1 .txt", "other.txt")
    )
    assert one.folder == same.folder
    assert one.folder.startswith("runs/mountaincar/program/depth-0/standard/seed-0~")
    assert other.folder.startswith("runs/mountaincar/program/depth-1/standard/seed-0~")
    assert other.config_yaml.count("depth: 1") == 1
    (trained,) = jobs("env=pendulum", "budget=quick", "seed=1", "depth=3")
    assert trained.folder == "runs/pendulum/otr/depth-3/quick/seed-1"


def test_figure_4_2_is_an_experiment():
    ours = jobs("+experiment=figure_4_2", "budget=smoke", "seed=0")
    assert [job.config.method.program for job in ours] == shipped_programs()
    assert {job.config.env.name for job in ours} == {"mountaincar"}


@pytest.mark.parametrize(
    "word", ["trainer=fleet", "algo=sac", "algo.gamma=0.9", "train.steps=100", "actor.dense=input"]
)
def test_settings_of_a_training_are_refused(word):
    with pytest.raises(ConfigError, match=f"^{word}: nothing is trained, as program=pid.txt is there already; leave"):
        jobs("env=pendulum", "program=pid.txt", word)


def test_answers_are_clipped_to_the_actions():
    states = np.array([[0.0, -1.0], [0.0, 0.25], [0.0, 2.0]])
    for text in ("return 2 velocity", "force = 2 velocity", "return clip(2 velocity, -5, 5)"):
        assert policy_tree(text, MOUNTAIN_CAR, "p").predict(states)[:, 0].tolist() == [-1, 0.5, 1]
    narrow = policy_tree("return clip(2 velocity, -0.25, 5)", MOUNTAIN_CAR, "p")
    assert narrow.predict(states)[:, 0].tolist() == [-0.25, 0.5, 1]
    torque = policy_tree("return 2 tanh(angle_rate)", PENDULUM, "p").predict([[0, 0, 1.0], [0, 0, 9.0]])
    np.testing.assert_allclose(torque[:, 0], 2 * np.tanh([1.0, 9.0]), rtol=1e-15)


@pytest.mark.parametrize(
    ("text", "env", "told"),
    [
        ("return 3 tanh(angle_rate)", PENDULUM, r"p: the answers go through tanh to \[-3.0\] .. \[3.0\], the actions"),
        ("return clip(angle_rate, 3, 4)", PENDULUM, "p: a clip to .* leaves none of the actions"),
        ("return 1, 2", PENDULUM, "p:1:8: this answer has 2 values, expected 1: the outputs are torque"),
        ("return 4", LANDER, "p:1:8: 4 is no label; labels are 0 to 3, or none, left_engine"),
        ("u = 1\nreturn argmax(0, 1)", PENDULUM, "p:2:8: argmax answers a label"),
    ],
)
def test_programs_that_are_no_policies(text, env, told):
    with pytest.raises(ConfigError, match=told):
        policy_tree(text, env, "p")


def test_labels_are_the_actions_names():
    tree = policy_tree(DESCENT, LANDER, "p")
    on_ground, falling, drifting = np.zeros((3, 8))
    on_ground[6:] = 1
    falling[3] = -0.3
    drifting[2] = 1
    assert tree.predict([on_ground, falling, drifting]).tolist() == [0, 2, 1]


def test_shipped_programs_are_listed_and_fit_their_environments():
    assert shipped_programs() == ["mountaincar", "mountaincar_simplified"]
    for name in shipped_programs():
        text = read_program(name, MOUNTAIN_CAR)
        assert text.startswith("# env=mountaincar")
        assert policy_tree(text, MOUNTAIN_CAR, name).n_leaves == 2
