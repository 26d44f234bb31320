"""Sweeps: jobs handed to a launcher until each has ended, and the same jobs as a file of commands.

Knows nothing of Hydra: `pipelines/cli` turns words into jobs and gives the function that launches them.
"""

import dataclasses
import itertools
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TypeVar

from pipelines.config import RunConfig
from pipelines.engine.job import Job, is_done
from pipelines.engine.store import write_text
from pipelines.errors import ConfigError
from pipelines.stages.fleets import fleets
from pipelines.stages.run_job import RunJob

FUTILE_ROUNDS = 3  # rounds in a row that lose a worker and finish no job, before a sweep gives up
LOST_WORKERS = {  # what joblib, submitit and Ray raise where a process or node doing a job has died
    "BrokenProcessPool", "UncompletedJobError", "NodeDiedError", "ObjectLostError", "OutOfMemoryError",
    "WorkerCrashedError",
}  # fmt: skip
EXTRAS = {  # launcher: the module that it needs and the extra that brings it
    "submitit_local": ("submitit", "slurm"),
    "slurm": ("submitit", "slurm"),
    "ray": ("ray", "ray"),
}


@dataclass(frozen=True)
class Outcome:
    """How a job of a sweep ended; without an error it is done."""

    folder: str
    error: str | None = None
    traceback: str | None = None


def check_launcher(name: str) -> None:
    """Raise ConfigError, naming the extra, where the launcher's plugin is not installed."""
    module, extra = EXTRAS.get(name, (None, None))
    if module and not (find_spec(module) and find_spec(f"hydra_plugins.hydra_{module}_launcher")):
        raise ConfigError(f"launcher={name} needs the extra {extra}: pip install 'otr[{extra}]'")


def run_sweep(jobs: Sequence[Job], launch: Callable[[Sequence[int]], list[Outcome]]) -> list[Outcome]:
    """Do every job that is not done, going on with those that are left whenever a launcher loses a worker.

    A worker that is killed takes the launcher's answers with it, so which jobs are done is read from their folders.
    What a lost worker was at goes on from its checkpoint.

    Args:
        jobs: the jobs.
        launch: does the jobs with these numbers and returns their outcomes in the same order.

    Returns:
        One outcome a job, in the jobs' order.
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


J = TypeVar("J", bound=Job)


def side_by_side(job: Job) -> Job:
    """Return a job that knows that others share its terminal and its cores."""
    job = _sharing(job)
    if isinstance(job, RunJob) and job.oracle:
        return dataclasses.replace(job, oracle=_sharing(job.oracle))
    return job


def _sharing(job: J) -> J:
    config = dataclasses.replace(job.config, side_by_side=True, n_workers=job.config.n_workers or 1)
    return dataclasses.replace(job, config=config)


def is_lost_worker(error: Exception) -> bool:
    """Return whether a launcher's error means that a process doing a job has died; by name, as plugins are extras."""
    return any(kind.__name__ in LOST_WORKERS for kind in type(error).__mro__)


def write_jobs(path: Path, jobs: Sequence[RunJob], words: Sequence[Sequence[str]]) -> int:
    """Write one shell command a line for every job that is not done, in the jobs' order; return how many lines.

    Runs that a fleet trains together are one line where a sweep of their own gives just them, else a line each.

    Args:
        path: the file.
        jobs: the jobs.
        words: the overrides of each job.
    """
    left = [(job, list(own)) for job, own in zip(jobs, words, strict=True) if not is_done(job)]
    lines = []
    for group in fleets([job.config for job, _ in left]):
        config, members = left[group[0]][0].config, [left[i][1] for i in group]
        together = sweep_words(members)
        lines += [job_command(config, own) for own in members] if together is None else [job_command(config, together)]
    write_text(path, "".join(f"{line}\n" for line in lines))
    return len(lines)


def sweep_words(members: Sequence[Sequence[str]]) -> list[str] | None:
    """Return the words of a sweep that makes just these jobs; None where there is no such sweep."""
    keys = [[word.split("=", 1)[0] for word in words] for words in members]
    if any(own != keys[0] for own in keys):
        return None
    values = [list(dict.fromkeys(column)) for column in zip(*members, strict=True)]
    if {tuple(words) for words in members} != set(itertools.product(*values)):
        return None
    listed = [f"{own[0].split('=', 1)[0]}={','.join(word.split('=', 1)[1] for word in own)}" for own in values]
    return [*(["-m"] if len(members) > 1 else []), *listed]


def job_command(config: RunConfig, words: Sequence[str]) -> str:
    """Return the complete command of a job, or of a fleet's, that shares its machine with others, for any shell."""
    own = [word for word in words if not is_sweep_word(word)]
    keys = {word.split("=")[0] for word in own}
    defaults = {"n_workers": "1", "side_by_side": "true", "results_dir": quoted(config.results_dir)}
    own += [f"{key}={value}" for key, value in defaults.items() if key not in keys]
    return shlex.join(["otr-run", *own])


def is_sweep_word(word: str) -> bool:
    """Return whether an override concerns how a sweep is launched, and no job."""
    return word.lstrip("+").startswith(("launcher=", "hydra.", "hydra/"))


def quoted(value: str) -> str:
    """Return a string as the value of a Hydra override."""
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return value if re.fullmatch("[A-Za-z0-9/._-]+", value) else f"'{escaped}'"


def how_to_use(path: Path, n_jobs: int) -> str:
    """Return how a file of jobs is run on one machine and on Slurm."""
    if not n_jobs:
        return f"{path}: no job is left"
    file = shlex.quote(str(path))
    wrapped = shlex.quote(f'sh -c "$(sed -n ${{SLURM_ARRAY_TASK_ID}}p {file})"')
    return (
        f"{path}: {n_jobs} commands. Eight at a time on this machine:\n"
        f"  tr '\\n' '\\0' < {file} | xargs -0 -P 8 -n 1 sh -c\n"
        "or on Slurm:\n"
        f"  sbatch --array=1-{n_jobs} --cpus-per-task=1 --mem=4G --time=1-0 --wrap {wrapped}"
    )
