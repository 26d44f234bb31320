"""Sweeps whatever launches them: lost workers, jobs that are done, what a launcher's process does with its group."""

import dataclasses
import pickle
import re
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool

import pytest

from pipelines.config.stages import ActorConfig
from pipelines.engine.job import disk_errors_explained, is_done, write_config
from pipelines.engine.store import read_json, write_json
from pipelines.engine.sweep import GroupTask, Outcome, check_launcher, run_sweep
from pipelines.errors import ConfigError, PipelineError
from pipelines.runs.run_job import RunJob, run_job, run_jobs
from tests.pipelines.conftest import ARS


@pytest.fixture
def jobs(tiny):
    return [RunJob(tiny(seed=seed), f"runs/seed-{seed}", "") for seed in range(3)]


@pytest.fixture
def done(monkeypatch):
    folders = set()
    monkeypatch.setattr("pipelines.engine.sweep.is_done", lambda job: job.folder in folders)
    monkeypatch.setattr("pipelines.runs.run_job.read_json", lambda path: {})
    return folders


def test_lost_worker_leaves_the_rest_to_another_round(jobs, done, capsys):
    rounds = []

    def launch(left):
        rounds.append(list(left))
        if len(rounds) == 1:
            done.add(jobs[1].folder)
            raise BrokenProcessPool("killed")
        return [Outcome(jobs[i].folder, "failed" if i == 2 else None) for i in left]

    outcomes = run_sweep(jobs, launch)
    assert rounds == [[0, 1, 2], [0, 2]]
    assert [(outcome.folder, outcome.error) for outcome in outcomes] == [
        ("runs/seed-0", None), ("runs/seed-1", None), ("runs/seed-2", "failed")]  # fmt: skip
    assert "going on with the 2 jobs that are left" in capsys.readouterr().out


def test_job_that_kills_its_worker_every_time_is_given_up_and_what_is_no_lost_worker_raised(jobs, done, capsys):
    done.add(jobs[0].folder)
    rounds = []

    def launch(left):
        rounds.append(list(left))
        raise error

    error = BrokenProcessPool("out of memory")
    first, *others = run_sweep(jobs, launch)
    assert rounds == [[1, 2]] * 3 and first.error is None and capsys.readouterr().out.count("done before") == 1
    assert all("3 times in a row" in outcome.error and "out of memory" in outcome.error for outcome in others)
    error = ConnectionError("no cluster there")
    with pytest.raises(ConnectionError):
        run_sweep(jobs, launch)


def test_a_job_is_done_when_every_file_is_as_it_was_written(tiny):
    job = RunJob(tiny(), "runs/one", "")
    assert not is_done(job)
    run_job(job)
    assert is_done(job)
    assert not is_done(RunJob(tiny(seed=1), "runs/one", ""))
    tree = job.run_dir / "prune" / "tree.npz"
    content = tree.read_bytes()
    tree.write_bytes(content[:-1])
    assert not is_done(job)
    tree.write_bytes(content)
    assert is_done(job)
    (job.run_dir / "summary.json").unlink()
    assert not is_done(job)


def test_a_summary_has_the_further_stages_that_are_done_and_no_others(tiny):
    certified = RunJob(tiny(certify=True), "runs/one", "")
    run_job(RunJob(tiny(), "runs/one", ""))
    run_job(RunJob(tiny(stages=["certify"]), "runs/one", ""))  # which makes no summary
    assert not is_done(certified)
    assert run_job(certified)["certify"]["certified"] and is_done(certified)
    path = certified.run_dir / "certify" / "manifest.json"
    write_json(path, read_json(path) | {"key": "of another actor"})
    assert "certify" not in run_job(RunJob(tiny(), "runs/one", ""))


@pytest.mark.parametrize(("launcher", "extra"), [("slurm", "slurm"), ("submitit_local", "slurm"), ("dask", "dask")])
def test_missing_plugin_names_the_extra(monkeypatch, launcher, extra):
    monkeypatch.setattr("pipelines.engine.sweep.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=re.escape(f"pip install 'otr[{extra}]'")):
        check_launcher(launcher)
    check_launcher("joblib")


# Hydra, and all that composes a configuration, cannot be imported in this process.
CALLED = """
import pathlib, pickle, sys
for name in ("hydra", "omegaconf", "hydra_plugins", "pipelines.cli"):
    sys.modules[name] = None
task = pickle.loads(pathlib.Path(sys.argv[1]).read_bytes())
print(task(True))
"""


def test_a_group_is_done_in_another_process_that_composes_nothing(tiny, tmp_path):
    search = {"algo": ARS, "actor": ActorConfig(0.0, dense="input")}  # which imports no torch
    job = RunJob(tiny(seed=1, n_workers=None, results_dir="results", **search), "runs/seed-1", "seed: 1\n")
    task = GroupTask([job], run_jobs, "today", str(tmp_path), {"OTR_RESULTS_DIR": None})
    (tmp_path / "task").write_bytes(pickle.dumps(task))
    command = [sys.executable, "-c", CALLED, str(tmp_path / "task")]
    done = subprocess.run(command, cwd="/", capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == str([Outcome("runs/seed-1")])
    assert (tmp_path / "results/runs/seed-1/summary.json").is_file()
    assert (tmp_path / "results/runs/seed-1/config.yaml").read_text() == "seed: 1\n"
    assert "pendulum depth 4 seed 1: train" in done.stdout  # as it does where others share the terminal


def test_the_configuration_is_written_anew_until_a_stage_is_finished(jobs):
    folder = jobs[0].run_dir
    (folder / ".train.tmp").mkdir(parents=True)
    (folder / ".train.tmp/manifest.json").touch()
    for text, kept in (("a", "a"), ("b", "b"), ("c", "b")):
        write_config(dataclasses.replace(jobs[0], config_yaml=text))
        assert (folder / "config.yaml").read_text() == kept
        if text == "b":
            (folder / ".train.tmp").rename(folder / "train")


def test_a_failure_of_a_whole_group_is_told_once(tiny, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    jobs = [RunJob(tiny(seed=seed), f"runs/seed-{seed}", "") for seed in range(3)]
    error = ConfigError("there is no such file\nlook elsewhere")
    task = GroupTask(jobs, lambda given: [error] * 2 + [ValueError("other")], "today", str(tmp_path), {})
    outcomes = task(False)
    assert [outcome.error for outcome in outcomes] == ["there is no such file"] * 2 + ["ValueError: other"]
    told = capsys.readouterr().err.splitlines()
    assert told == ["runs/seed-0 failed: there is no such file", "look elsewhere", "runs/seed-1 failed: so, too",
                    "runs/seed-2 failed: ValueError: other"]  # fmt: skip


def test_a_file_that_is_missed_is_not_told_as_the_disk(jobs):
    for error, told in (
        (FileNotFoundError(2, "gone", "track.npz"), FileNotFoundError),
        (OSError(28, "full"), PipelineError),
    ):
        with pytest.raises(told), disk_errors_explained(jobs[0]):
            raise error
