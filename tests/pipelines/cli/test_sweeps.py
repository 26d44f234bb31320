"""Sweeps as commands: the same jobs under every launcher, killed workers, sweeps side by side."""

import os
import re
import signal
import stat
from pathlib import Path

import pytest
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from pipelines.config.conf_dir import CONF_DIR
from tests.pipelines.conftest import otr_command, otr_program
from tests.pipelines.sweeps import PROGRAMS, STAGES, THREE, children, digests, start, times_made, wait_for

LINUX = pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes under /proc")


@pytest.fixture(scope="module")
def one_by_one(tmp_path_factory):
    folder = tmp_path_factory.mktemp("basic")
    done = otr_program("otr-run", *THREE, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert times_made(done.stdout) == dict.fromkeys(STAGES, 3)
    found = digests(folder / "results")
    assert len(found) == 3 * (4 + 3 + 3 + 3)  # of the stages in order; critics are the fourth of train
    return found


@LINUX
@pytest.mark.slow  # test_stage.py has two processes at one stage
def test_two_sweeps_on_one_folder_do_each_job_once(one_by_one, tmp_path):
    launchers = (("launcher=basic",), ("launcher=joblib", "hydra.launcher.n_jobs=2"))
    sweeps = [start(*THREE, *launcher, cwd=tmp_path) for launcher in launchers]
    printed = [sweep.communicate(timeout=300)[0] for sweep in sweeps]
    assert [sweep.returncode for sweep in sweeps] == [0, 0], printed
    assert all("3 jobs: 3 done, 0 failed" in text for text in printed)
    assert times_made("\n".join(printed)) == dict.fromkeys(STAGES, 3)
    assert digests(tmp_path / "results") == one_by_one


@LINUX
def test_sweep_goes_on_where_a_worker_is_killed(tmp_path):
    search = ("algo=ars", "budget=smoke", "train.steps=3_000_000", "train.eval_interval_steps=300_000")  # without torch
    words = ("-m", "env=pendulum", "depth=1,2", *search, "launcher=joblib", "hydra.launcher.n_jobs=2")
    results = tmp_path / "results"
    with start(*words, cwd=tmp_path) as sweep:
        wait_for(lambda: list(results.glob("checkpoints/*/segment-*")))
        finished = {path: path.stat().st_mtime_ns for path in results.glob("runs/**/manifest.json")}
        os.kill(children(sweep.pid, "LokyProcess")[0], signal.SIGKILL)
        printed, _ = sweep.communicate(timeout=300)
    assert sweep.returncode == 0, printed
    for message in ("a worker was lost", "going on from step", "2 jobs: 2 done, 0 failed"):
        assert message in printed
    assert not any((results / "sweeps").iterdir())
    assert len(list(results.glob("runs/**/summary.json"))) == 2
    assert {path: path.stat().st_mtime_ns for path in finished} == finished
    assert max(times_made(printed).values()) <= 2
    assert len(re.findall(r"step ([\d,]+)/\1 ", printed)) == 2  # each training came to its end once
    assert not any((results / "checkpoints").iterdir())


@pytest.mark.parametrize("launcher", [(), ("launcher=joblib", "hydra.launcher.n_jobs=1")])  # both in this process
def test_hydra_composes_nothing_for_a_sweep_s_processes(tmp_path, monkeypatch, launcher):
    with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader().__class__
    monkeypatch.setattr(loader, "load_sweep_config", None)
    words = (*PROGRAMS, *launcher, "stages=parse")  # one value for a list, which Hydra refuses
    done = otr_command("otr-run", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 jobs: 2 done, 0 failed" in done.stdout
    assert not any((tmp_path / "results/sweeps").iterdir())  # the pickled tasks are gone


SBATCH = {  # what submitit gives by itself is not listed
    "array": "0-1%2", "cpus-per-task": "1", "job-name": "otr", "mem": "4GB", "nodes": "1", "ntasks-per-node": "1",
    "open-mode": "append", "output": "FOLDER/%A_%a/%A_%a_0_log.out", "partition": "cpu", "signal": "USR2@120",
    "time": "1440",
}  # fmt: skip
# Slurm as far as submitit knows it: an array whose tasks run here, one after the other.
FAKES = {
    "sbatch": """\
cp "$1" "$FAKE_SLURM/sbatch.txt"
command=$(sed -n 's/^srun .*_log.err //p' "$1")
folder=$(sed -n 's/.*--output=\\(.*\\)\\/%A_%a\\/.*/\\1/p' "$1")
(
  export SUBMITIT_EXECUTOR=slurm SLURM_JOB_NUM_NODES=1 SLURM_NTASKS=1 SLURM_JOB_NODELIST=here SLURM_NODEID=0
  export SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_ARRAY_JOB_ID=12
  for i in 0 1; do
    while [ ! -e "$folder/12_$i/12_${i}_submitted.pkl" ]; do sleep 0.1; done
    unset OTR_RESULTS_DIR
    (cd / && SLURM_JOB_ID=12_$i SLURM_ARRAY_TASK_ID=$i sh -c "$command" > "$FAKE_SLURM/log_$i" 2>&1)
  done
) > "$FAKE_SLURM/tasks" 2>&1 &
echo Submitted batch job 12
""",
    "srun": "exit 1\n",
    "sacct": "echo 'JobID|State|NodeList'\necho '12_0|RUNNING|here'\necho '12_1|RUNNING|here'\n",
}


def test_slurm_is_handed_one_array(tmp_path):
    for name, text in FAKES.items():
        program = tmp_path / "bin" / name
        program.parent.mkdir(exist_ok=True)
        program.write_text(f"#!/bin/bash\n{text}")
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
    path = f"{tmp_path / 'bin'}:{os.environ['PATH']}"
    environment = {"PATH": path, "FAKE_SLURM": str(tmp_path), "OTR_RESULTS_DIR": "elsewhere"}
    words = (*PROGRAMS, "launcher=slurm", "hydra.launcher.partition=cpu")
    done = otr_program("otr-run", *words, cwd=tmp_path, **environment)
    assert done.returncode == 0, done.stdout + done.stderr
    text = (tmp_path / "sbatch.txt").read_text().replace(str(tmp_path / "elsewhere/sweeps/.submitit"), "FOLDER")
    assert SBATCH.items() <= dict(re.findall(r"#SBATCH --([\w-]+)=(.*)", text)).items()
    assert "\nsrun --unbuffered --output FOLDER/%A_%a/%A_%a_%t_log.out --error FOLDER/" in text
    assert otr_command("otr-run", *PROGRAMS, cwd=tmp_path).returncode == 0
    expected = digests(tmp_path / "results")
    assert len(expected) == 20 and digests(tmp_path / "elsewhere") == expected
    assert [path.name for path in (tmp_path / "elsewhere/sweeps").iterdir()] == [".submitit"]
