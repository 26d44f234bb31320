"""Sweeps: the time to compose a table's 560 jobs, and what a launcher adds to each job.

The plan is `otr-plan +experiment=table_4_1` with no run done, in CPU seconds, start of the process included. A
launcher's overhead is the time of a sweep of smoke jobs beyond the same jobs done by `run_job` one after the other in
one process, divided by their number; one job at a time in both, start of the processes included. Slurm's launcher
starts a process for every job, without Slurm here: a sweep of one job is compared with the plain `otr-run` of that job.

Target: 560 jobs in at most 10 CPU seconds; at most 2 s a job.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.measure import Entry, alternate

JOB = ("env=pendulum", "depth=1", "budget=smoke", "n_workers=1")
JOBS_ALONE = """
import sys
from pipelines.cli.runs import RUN
from pipelines.runs.run_job import run_job
for job in RUN.jobs(RUN.expand(sys.argv[1:], multirun=True)):
    run_job(job)
"""


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick does three jobs once instead of ten three times over."""
    n_jobs, rounds = (3, 1) if quick else (10, 3)
    (plan_s,) = alternate(command("otr-plan", "+experiment=table_4_1"), rounds=rounds, clock=children_s)
    entries = [Entry("otr-plan of 560 jobs", plan_s, "s", target="value <= 10")]
    overrides = (*JOB, f"seed=range(0,{n_jobs})")
    alone = python(JOBS_ALONE, *overrides)
    for launcher in ("basic", "joblib"):
        one_at_a_time = ["hydra.launcher.n_jobs=1"] * (launcher == "joblib")
        sweep = command("otr-run", "-m", *overrides, f"launcher={launcher}", *one_at_a_time)
        entries.append(overhead(f"a job more in a sweep, launcher={launcher}", sweep, alone, n_jobs, rounds))
    sweep = command("otr-run", "-m", *JOB, "launcher=submitit_local")
    entries.append(overhead("a job under Slurm's launcher", sweep, command("otr-run", *JOB), 1, rounds))
    return entries


def children_s() -> float:
    """Return the CPU seconds of the processes that this one has started and that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def overhead(name: str, sweep: Callable[[], None], alone: Callable[[], None], n_jobs: int, rounds: int) -> Entry:
    """Return the seconds a job that the sweep takes beyond the same jobs alone."""
    ours, theirs = alternate(sweep, alone, rounds=rounds, clock=time.perf_counter)
    print(f"sweeps: {name}: {n_jobs} jobs in {ours:.1f} s, alone in {theirs:.1f} s", flush=True)
    return Entry(name, (ours - theirs) / n_jobs, "s", target="value <= 2", clock="wall")


def command(program: str, *arguments: str) -> Callable[[], None]:
    """Return a function that runs one of our commands in an empty folder."""
    return in_empty_folder(str(Path(sys.executable).with_name(program)), *arguments)


def python(code: str, *arguments: str) -> Callable[[], None]:
    """Return a function that runs Python code in an empty folder."""
    return in_empty_folder(sys.executable, "-c", code, *arguments)


def in_empty_folder(*arguments: str) -> Callable[[], None]:
    """Return a function that runs a command, without its output, in a new empty folder."""

    def run() -> None:
        with tempfile.TemporaryDirectory() as folder:
            full = [*arguments, f"results_dir={folder}/results"]
            subprocess.run(full, cwd=folder, check=True, stdout=subprocess.DEVNULL, timeout=600)

    return run
