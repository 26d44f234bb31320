"""Helpers of the tests of sweeps and kills: start a process, wait for it, count what it made."""

import itertools
import json
import multiprocessing
import os
import pkgutil
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

THREE = ("-m", "env=pendulum", "depth=1,2,3", "budget=smoke", "algo.critic=[16]")
# Two jobs that train nothing and do not import torch, where it is enough that jobs are done.
PROGRAMS = ("-m", "env=mountaincar", "program=mountaincar,mountaincar_simplified", "budget=smoke", "n_workers=1")
STAGES = ("train", "map", "prune", "evaluate")
TIMED = ("progress.csv",)  # holds seconds


# Children of a server that has imported torch and Stable-Baselines3: each alone would import them for seconds.
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["pipelines.training.sb3.training", "torch._dynamo"])


def run_until_killed(function, *args):
    child = SERVER.Process(target=function, args=args)
    child.start()
    child.join(timeout=120)
    assert child.exitcode == -signal.SIGKILL


def do_until_killed(jobs, where, n, after=False):
    """Do jobs in a process that ends itself by SIGKILL before, or after, the nth call of the function `where`."""
    run_until_killed(_do_and_die, jobs, where, n, after)


def _do_and_die(jobs, where, n, after):
    from pipelines.runs.run_job import run_jobs

    place, name = where.rsplit(".", 1)
    owner, calls = pkgutil.resolve_name(place), itertools.count(1)
    function = getattr(owner, name)

    def dying(*args, **options):
        is_last = next(calls) == n
        if is_last and not after:
            os.kill(os.getpid(), signal.SIGKILL)
        result = function(*args, **options)
        if is_last:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(owner, name, dying)
    run_jobs(jobs)


def digests(results):
    """Return {run/stage/file: sha256} of what every finished stage below `results` left, but for what is timed."""
    found = {}
    for manifest in sorted(results.glob("runs/**/manifest.json")):
        for name, digest in json.loads(manifest.read_text())["outputs"].items():
            if name not in TIMED and name != "report.json":
                found[str(manifest.relative_to(results).with_name(name))] = digest
    return found


def times_made(printed):
    """Return {stage: how often it was made} as the jobs of one or several sweeps printed it."""
    # Not by lines: processes that share a pipe may write theirs into one.
    return {stage: len(re.findall(rf"{stage}: [\d.]+ (?:s|min)", printed)) for stage in STAGES}


def start(*words, cwd, **environment):
    code = "import sys; sys.argv[0] = 'otr-run'; from pipelines.cli import run; run()"
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen([sys.executable, "-c", code, *words], cwd=cwd, env={**os.environ, **environment}, **streams)


def wait_for(found, seconds=120):
    deadline = time.monotonic() + seconds
    while not (value := found()):
        assert time.monotonic() < deadline, "nothing came"
        time.sleep(0.05)
    return value


def children(pid, word=""):
    """Return the ids of the child processes whose command line has a word in it (Linux)."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            fits = word in path.read_text()
            parent = int(path.with_name("stat").read_text().rsplit(")", 1)[1].split()[1])
        except OSError:
            continue
        if fits and parent == pid:
            found.append(int(path.parent.name))
    return found
