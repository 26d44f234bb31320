"""Sweeps: jobs handed to a launcher until each has ended, and how a launcher's processes do them.

Nothing here knows Hydra, runs or fits: `pipelines/cli` composes the jobs and gives the function that launches them.
"""

import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from pipelines.engine.job import Job, is_done, message_of, record_failure
from pipelines.errors import ConfigError

FUTILE_ROUNDS = 3  # rounds in a row that lose a worker and finish no job, before a sweep gives up
# What joblib, submitit and Dask raise where a process or node doing a job has died
LOST_WORKERS = {"BrokenProcessPool", "UncompletedJobError", "KilledWorker"}
LAUNCHERS = {  # optional launchers: the modules that a launcher needs and the extra that brings them
    "submitit_local": (("submitit", "hydra_plugins.hydra_submitit_launcher"), "slurm"),
    "slurm": (("submitit", "hydra_plugins.hydra_submitit_launcher"), "slurm"),
    "dask": (("distributed",), "dask"),
}


@dataclass(frozen=True)
class Outcome:
    """How a job of a sweep ended; without an error it is done."""

    folder: str
    error: str | None = None
    traceback: str | None = None


def check_launcher(name: str) -> None:
    """Raise ConfigError, naming the extra, where what a launcher needs is not installed."""
    modules, extra = LAUNCHERS.get(name, ((), None))
    if not all(find_spec(module) for module in modules):
        raise ConfigError(f"launcher={name} needs the extra {extra}: pip install 'otr[{extra}]'")


def run_sweep(jobs: Sequence[Job], launch: Callable[[Sequence[int]], list[Outcome]]) -> list[Outcome]:
    """Do every job that is not done, and continue with the rest whenever a launcher loses a worker.

    A worker that is killed takes the launcher's answers with it, so which jobs are done is read from their folders.
    The job of a lost worker resumes from its checkpoint. `launch` does the jobs with these numbers and returns their
    outcomes in the same order.
    """
    outcomes: dict[int, Outcome] = {}
    for i, job in enumerate(jobs):
        if is_done(job):
            print(f"{job.run_dir}: done before", flush=True)
            job.found_done()
            outcomes[i] = Outcome(job.folder)
    left, n_futile = [i for i in range(len(jobs)) if i not in outcomes], 0
    while left:
        try:
            outcomes |= zip(left, launch(left), strict=True)
            break
        except Exception as error:
            if not is_lost_worker(error):
                raise
            reason = f"{type(error).__name__}: {str(error).splitlines()[0]}" if str(error) else type(error).__name__
        done = [i for i in left if is_done(jobs[i])]
        outcomes |= {i: Outcome(jobs[i].folder) for i in done}
        left = [i for i in left if i not in done]
        n_futile = 0 if done else n_futile + 1
        if n_futile == FUTILE_ROUNDS:
            why = f"workers were lost {FUTILE_ROUNDS} times in a row and no job came to an end ({reason})"
            outcomes |= {i: Outcome(jobs[i].folder, why) for i in left}
            break
        if left:
            print(f"a worker was lost ({reason}); going on with the {len(left)} jobs that are left", flush=True)
    return [outcomes[i] for i in range(len(jobs))]


def is_lost_worker(error: Exception) -> bool:
    """Return whether a launcher's error means that a process doing a job has died; by name, as plugins are extras."""
    return any(kind.__name__ in LOST_WORKERS for kind in type(error).__mro__)


@dataclass(frozen=True)
class GroupTask:
    """Does a group of a sweep's jobs in a launcher's process; reports failures instead of raising them."""

    jobs: Sequence[Job]
    do: Callable[[Sequence[Any]], list[Exception | None]]  # does jobs and returns what each failed with, or None
    sweep: str  # names the folder of the sweep's failures
    cwd: str  # the folder in which the command was given, which relative paths start from
    environment: Mapping[str, str | None]  # the variables there that jobs depend on; None where one is not set

    def __call__(self, side_by_side: bool) -> list[Outcome]:
        """Return how each job ended; `side_by_side` says whether other groups are done at the same time."""
        os.chdir(self.cwd)
        for name, value in self.environment.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
        jobs = [job.side_by_side() for job in self.jobs] if side_by_side else self.jobs
        errors = self.do(jobs)
        before = [None, *errors[:-1]]
        return [self._outcome(*each) for each in zip(jobs, errors, before, strict=True)]

    def _outcome(self, job: Job, error: Exception | None, before: Exception | None) -> Outcome:
        """Return how a job ended; an error of a whole group is reported with the first of its jobs alone."""
        if error is None:
            return Outcome(job.folder)
        path = record_failure(job, error, self.sweep)
        message = message_of(error)
        if job.config.debug:
            traceback.print_exception(error)
        print(f"{job.folder} failed: {'so, too' if error is before else message}", file=sys.stderr, flush=True)
        return Outcome(job.folder, message.splitlines()[0], path)
