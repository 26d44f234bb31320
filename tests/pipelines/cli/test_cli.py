"""The commands as a user types them: what they print, leave, skip and refuse."""

import contextlib
import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

import pipelines
from pipelines.cli.runs import run_config
from pipelines.config.conf_dir import CONF_DIR
from tests.pipelines.conftest import otr_command, otr_program
from tests.pipelines.sweeps import PROGRAMS, children, wait_for

PROGRAMS_OF_OTR = ("otr-run", "otr-plan", "otr-fit", "otr-tabulate", "otr-export", "otr-verify", "otr-report")
SMOKE = ("env=pendulum", "depth=3", "budget=smoke", "n_workers=1")
RUN = Path("results/runs/pendulum/otr/depth-3/smoke/seed-0")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    done = otr_program("otr-run", *SMOKE, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_main_job_leaves_every_artefact_and_prints_table_program_and_place(finished):
    folder, printed = finished
    files = {str(path.relative_to(folder / RUN)) for path in (folder / RUN).rglob("*") if path.is_file()}
    trees = {"tree.npz", "tree.json", "program.txt", "report.json", "manifest.json"}
    made = {
        "train": {"actor.safetensors", "actor.json", "progress.csv", "evaluations.csv", "manifest.json"},
        "map": trees, "prune": trees, "evaluate": {"episodes.csv", "manifest.json"},
    }  # fmt: skip
    assert files >= {"config.yaml", "summary.json"} | {f"{stage}/{name}" for stage in made for name in made[stage]}
    assert not any((folder / "results/checkpoints").iterdir())
    summary = json.loads((folder / RUN / "summary.json").read_text())
    with (folder / RUN / "evaluate/episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["seed"]) for row in rows] == [1000, 1001]
    assert list(rows[0]) == ["episode", "seed", "return", "length", "terminated", "truncated"]
    assert summary["return_mean"] == pytest.approx(sum(float(row["return"]) for row in rows) / 2, rel=1e-12)
    assert summary["policies"]["network"] == summary["policies"]["tree"]
    assert (summary["n_leaves"], summary["depth"], summary["n_episodes"]) == (8, 3, 2)
    assert 1 <= summary["pruned_leaves"] <= 8
    for words in ("Pendulum-v1", "network", "pruned tree", "activation patterns reached", str(RUN), "return 2 tanh("):
        assert words in printed


def test_second_time_everything_is_skipped_also_with_defaults_given_in_words(finished):
    folder, _ = finished
    before = (folder / RUN / "train/manifest.json").stat().st_mtime_ns
    for words in ((), ("algo=sac", "algo.gamma=0.99")):
        done = otr_command("otr-run", *SMOKE, *words, cwd=folder)
        assert done.returncode == 0 and done.stdout.count("done before") == 4
    assert (folder / RUN / "train/manifest.json").stat().st_mtime_ns == before


def test_other_evaluation_reuses_the_training(finished, tmp_path):
    shutil.copytree(finished[0] / "results", tmp_path / "results")
    done = otr_command("otr-run", *SMOKE, "evaluate.n_episodes=3", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("done before") == 3
    (other,) = (tmp_path / RUN).parent.glob("seed-0~*")
    assert json.loads((other / "summary.json").read_text())["n_episodes"] == 3


def test_plan_says_skip_and_run(finished):
    folder, _ = finished
    done = otr_command("otr-plan", "-m", *SMOKE[:1], "depth=3,5", *SMOKE[2:], cwd=folder)
    lines = {line.split()[0]: line.split()[1] for line in done.stdout.splitlines() if "runs/" in line}
    assert lines == {"runs/pendulum/otr/depth-3/smoke/seed-0": "skip", "runs/pendulum/otr/depth-5/smoke/seed-0": "run"}
    assert "2 jobs: 1 to skip, 1 left" in done.stdout


def test_plan_misses_a_summary(finished, tmp_path):
    shutil.copytree(finished[0] / "results", tmp_path / "results")
    summary = tmp_path / RUN / "summary.json"
    for break_it in (summary.unlink, lambda: summary.write_text("{")):
        break_it()
        done = otr_command("otr-plan", *SMOKE, cwd=tmp_path, COLUMNS="200")
        assert "write the summary" in done.stdout and "1 job: 0 to skip, 1 left" in done.stdout, done.stdout
        assert otr_command("otr-run", *SMOKE, cwd=tmp_path).returncode == 0
        assert json.loads(summary.read_text())["schema"]


def test_replay_gives_the_recorded_episodes_and_finds_one_that_was_changed(finished, tmp_path):
    shutil.copytree(finished[0] / "results", tmp_path / "results")
    done = otr_command("otr-tabulate", "table=4.1", "evaluate=true", cwd=tmp_path)
    assert done.returncode == 0 and done.stdout.count("as recorded") == 3, done.stderr
    path = tmp_path / RUN / "evaluate/episodes.csv"
    lines = path.read_text().splitlines()
    fields = lines[2].split(",")
    fields[2] = "-1.0"
    path.write_text("\n".join([*lines[:2], ",".join(fields)]) + "\n")
    done = otr_command("otr-tabulate", "table=4.1", "evaluate=true", cwd=tmp_path)
    assert done.returncode == 1
    assert "tree: 2 episodes played again, 1 differ, the first is episode 1" in done.stdout
    actor = tmp_path / RUN / "train/actor.safetensors"
    actor.write_bytes(actor.read_bytes()[:-8])
    done = otr_command("otr-run", *SMOKE, cwd=tmp_path)
    assert done.returncode == 1 and "is not what was written" in done.stderr


BAD_REQUESTS = (
    (("env=hoper",), "Did you mean hopper"),
    (("dpeth=6",), "there is no key 'dpeth'. Did you mean depth"),
    (("program=a.txt", "model=b.zip"), "program=a.txt and model=b.zip are two policies; leave one of them out"),
    (("depth=6",), "besides, any registered id, as CartPole-v1 or my_module:Maze-v0"),
    (("env=pendulum", "trainer=null"), "trainer=null: there is no such trainer. There are: fleet, sb3"),
    (("env=pendulum", "budget=fast"), "There are: quick, smoke, standard, thesis"),
    (("env=pendulum", "algo.gama=0.9"), "Did you mean algo.gamma"),
    (("env=pendulum", "gamma=0.9"), "algo.gamma"),
    (("env=pendulum", "seed=null"), "seed=null: give a whole number from 0 to 4294967295"),
    (("env=pendulum", "seed=-1"), "seed=-1 is not between 0 and 4294967295"),
    (("env=pendulum", "stages=[train]", "polish=true"), "polish=true and stages=[train], which has no polish"),
    (("-m", "env=mountaincar", "depth=1", "polish=false,true", "certify=true"), "two jobs of this sweep make the"),
    (("env=pendulum", "certify=maybe"), "certify=maybe: give true or false"),
    (("env=pendulum", "algo.critic=[64,wide]"), "algo.critic[1]=wide: algo.critic is a list of whole numbers of"),
    (("env=pendulum", "stages=map,prune"), "add -m, or write one list as stages=[...]"),
    (("env=pendulum", "depth=glob(*)"), "depth=glob(*): give values, range() or choice()"),
    (("pendulum",), "pendulum is no key=value. Did you mean env=pendulum?"),
    (("env=pendulum", "budgets"), "settings are given as env=ant"),
    (("env=pendulum", "method=linear", "depth=6"), "leave depth out"),
    (("env=pendulum", "depth=-3", "debug=true"), "Traceback"),
    (("env=pendulum", "method=viperr"), "there is no such method"),
    (("env=pendulum", "stages=[mapp]"), "no stage 'mapp'"),
    (("env=pendulum", "launcher=joblib"), "launcher=joblib launches a sweep's jobs, and this is one job"),
    (("-m", "env=pendulum", "launcher=joblib", "hydra.launcher.njobs=1"), "launcher=joblib has no setting 'njobs'"),
    (("-m", "env=pendulum", "hydra.launcher.n_jobs=1"), "no launcher was chosen that has it"),
    (("env=pendulum", "oracle=[64]"), "oracle=[64]: nothing is imitated. Add method=viper or"),
    (("-m", "env=pendulum", "method=otr,sdt", "imitate.n_rounds=3"), "imitate.n_rounds=3: nothing is imitated"),
    (("env=pendulum", "stages=[]"), "stages=[] does nothing; name stages"),
    (("env=pendulum", "env.id=Nothing-v0", "budget=smoke"), "Nothing-v0"),
    (("env=lunarlander", "algo=sac", "budget=smoke"), "use algo=ppo"),
    (("+experiment=table_4_2x",), "there is no such experiment"),
    (("-m", "env=pendulum", "depth=2,-1", "budget=smoke"), "depth=-1"),
    (("-m", "env=pendulum", "+experiment=smoke,table_4_1"), "experiment: one at a time"),
    (("env=pendulum", "+foo=1"), "leave out the +"),
    (("env=pendulum", "results_dir="), "results_dir is empty"),
    (("env=pendulum", "trainer=fleet", "trainer.n_env=3"), "Did you mean trainer.n_envs"),
)


@pytest.mark.parametrize(("words", "message"), BAD_REQUESTS)
def test_bad_requests_are_one_clear_message(tmp_path, words, message):
    done = otr_command("otr-run", *words, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert ("Traceback" in done.stderr + done.stdout) == ("debug=true" in words)
    assert [path for path in tmp_path.rglob("runs/**/*") if path.is_file() and path.suffix != ".lock"] == []


def test_missing_inputs_and_runs_are_named(tmp_path):
    done = otr_command("otr-run", *SMOKE, "stages=[map]", cwd=tmp_path)
    assert done.returncode == 1 and "Run: otr-run env=pendulum depth=3 budget=smoke n_workers=1" in done.stderr
    done = otr_command("otr-tabulate", "table=4.1", "results_dir=nope", cwd=tmp_path)
    assert done.returncode == 2 and "there is no folder nope/runs" in done.stderr


def test_results_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "results").write_text("a file where a folder should be")
    for words in (SMOKE, ("-m", *SMOKE)):
        done = otr_command("otr-run", *words, cwd=tmp_path)
        assert done.returncode == 1
        assert "Not a directory" in done.stderr and "results_dir=PATH" in done.stderr
        assert "NotADirectoryError" not in done.stderr and "Traceback" not in done.stderr


def test_full_disk_is_told_and_the_same_command_goes_on(tmp_path):
    program = Path(sys.executable).with_name("otr-run")
    words = ("env=pendulum", "depth=32", "algo=ars", "budget=smoke", "n_workers=1")
    limited = f"ulimit -f 4; exec {program} {' '.join(words)}"  # no file above 4 KiB: the checkpoint does not fit
    done = subprocess.run(["bash", "-c", limited], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1
    assert "Make room there or choose another place" in done.stderr and "Traceback" not in done.stderr
    assert not list(tmp_path.glob("results/runs/**/train")) and not list(tmp_path.rglob("*.tmp"))
    assert not Path(pipelines.__file__).parents[1].joinpath(".git/index.lock").exists()
    assert otr_command("otr-run", *words, cwd=tmp_path).returncode == 0
    assert len(list(tmp_path.glob("results/runs/**/summary.json"))) == 1


@pytest.mark.parametrize(("launcher", "runner"), [("basic", otr_command), ("joblib", otr_program)])
def test_failing_job_does_not_stop_a_sweep(tmp_path, launcher, runner):
    assert otr_command("otr-run", *PROGRAMS, cwd=tmp_path).returncode == 0
    summaries = {json.loads(path.read_text())["program"]: path for path in tmp_path.glob("results/**/summary.json")}
    for path in summaries.values():
        shutil.rmtree(path.parent)
    summaries["mountaincar"].parent.write_text("in the way")
    done = runner("otr-run", *PROGRAMS, f"launcher={launcher}", cwd=tmp_path)
    assert done.returncode == 1
    assert "2 jobs: 1 done, 1 failed" in done.stdout, done.stdout + done.stderr
    (row,) = [line.split() for line in done.stdout.splitlines() if line.startswith("  mountaincar/program/")]
    summary = json.loads(summaries["mountaincar_simplified"].read_text())
    assert row[1:4] == [f"{summary['return_mean']:.1f}", "±", f"{summary['return_std']:.1f}"]
    assert row[-1] == str(summary["pruned_leaves"])
    assert str(summaries["mountaincar"].parent.relative_to(tmp_path / "results")) in done.stdout
    assert summaries["mountaincar_simplified"].exists()
    (failure,) = (tmp_path / "results/failures").rglob("*.txt")
    assert "Traceback" in failure.read_text() and "program=mountaincar " in failure.read_text()


def running_in_group(group):
    """Return the ids of the processes of a group that are neither gone nor waiting to be reaped (Linux)."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, process_group = path.read_text().rsplit(")", 1)[1].split()[:3]
            if int(process_group) == group and state != "Z":
                found.append(int(path.parent.name))
    return found


def in_foreground(*words: str, cwd: Path) -> subprocess.Popen[str]:
    """Start otr-run so that ctrl-C stops it, as in a terminal, also where these tests run in the background."""
    return subprocess.Popen(
        [str(Path(sys.executable).with_name("otr-run")), *words], cwd=cwd, stdout=subprocess.PIPE, text=True,
        stderr=subprocess.STDOUT, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes under /proc")
def test_stopped_while_workers_play(tmp_path):
    words = ("env=mountaincar", "program=mountaincar", "prune.n_episodes=20000", "n_workers=2")
    with in_foreground(*words, cwd=tmp_path) as process:
        next(line for line in process.stdout if line.startswith("parse:"))
        wait_for(lambda: len(children(process.pid, "spawn_main")) == 2)
        time.sleep(1)  # they import, then play
        os.killpg(process.pid, signal.SIGINT)
        printed, _ = process.communicate(timeout=60)
    assert process.returncode == 130, printed
    assert "the same command goes on" in printed and "Traceback" not in printed
    wait_for(lambda: not running_in_group(process.pid), seconds=20)


def test_a_reader_that_has_seen_enough(finished):
    program = Path(sys.executable).with_name("otr-run")
    line = f"{program} {' '.join(SMOKE)} | head -0; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", line], cwd=finished[0], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (141, "")


def test_ctrl_c_stops_cleanly_and_goes_on(tmp_path):
    search = ("algo=ars", "budget=smoke", "train.steps=3_000_000", "train.eval_interval_steps=300_000")
    with in_foreground("env=pendulum", "depth=2", *search, cwd=tmp_path) as process:
        wait_for(lambda: list((tmp_path / "results/checkpoints").glob("*/segment-*")))
        process.send_signal(signal.SIGINT)
        printed, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "the same command goes on" in printed and "Traceback" not in printed
    done = otr_command("otr-run", "env=pendulum", "depth=2", *search, cwd=tmp_path)
    assert done.returncode == 0 and "going on from step" in done.stdout


@pytest.mark.parametrize(
    "budget", ["quick", pytest.param("thesis", marks=pytest.mark.slow), pytest.param("smoke", marks=pytest.mark.slow)]
)
def test_every_environment_and_budget_composes(tmp_path, budget):
    names = sorted(path.stem for path in (CONF_DIR / "env").glob("*.yaml"))
    assert len(names) == 16
    done = otr_command("otr-plan", "-m", f"env={','.join(names)}", f"budget={budget}", cwd=tmp_path)
    assert "16 jobs: 0 to skip, 16 left" in done.stdout, done.stderr
    own = run_config(["env=pendulum", f"budget={budget}"]).budget
    tasks = {*(name.removesuffix("_v5") for name in names), "discrete", "continuous"}
    for table in (own.steps, own.on_policy_steps, own.polish_steps, own.search):
        assert {*table} - {"others"} <= tasks and (tasks <= {*table} or "others" in table)


def test_help_names_the_overrides_and_every_command_its_version():
    version = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]["version"]
    for program in PROGRAMS_OF_OTR:
        done = otr_command(program, "--help", cwd=Path.cwd())
        assert done.returncode == 0 and "overrides:" in done.stdout and "--version" in done.stdout
        done = otr_command(program, "--version", cwd=Path.cwd())
        assert (done.returncode, done.stdout) == (0, f"{program} {version}\n")
