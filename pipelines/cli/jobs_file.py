"""The remaining jobs of a sweep as a file of commands, for xargs or an array of a cluster's jobs."""

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pipelines.cli.overrides import combined, is_of_launching, quoted
from pipelines.engine.job import Job, is_done
from pipelines.engine.store import write_text


def write_jobs(path: Path, jobs: Sequence[Job], groups: Callable[[Sequence[Any]], list[list[int]]]) -> int:
    """Write one shell command a line for every job that is not done, in the jobs' order; return how many lines.

    Jobs that one process does together (`groups`: positions of configurations) are one line where one sweep
    gives exactly these, else a line each.
    """
    left = [job for job in jobs if not is_done(job)]
    lines = []
    for group in groups([job.config for job in left]):
        members = [left[i] for i in group]
        together = combined([job.overrides for job in members])
        asked = [job.overrides for job in members] if together is None else [together]
        lines += [job_command(members[0], overrides) for overrides in asked]
    write_text(path, "".join(f"{line}\n" for line in lines))
    return len(lines)


def job_command(job: Job, overrides: Sequence[str]) -> str:
    """Return the complete command of a job, or of a group, that shares its machine with others, for any shell."""
    own = [override for override in overrides if not is_of_launching(override)]
    keys = {override.split("=")[0] for override in own}
    defaults = {"n_workers": "1", "side_by_side": "true", "results_dir": quoted(job.config.results_dir)}
    own += [f"{key}={value}" for key, value in defaults.items() if key not in keys]
    return shlex.join([job.program, *own])


def how_to_use(path: Path, n_jobs: int) -> str:
    """Return how a file of jobs is run on one machine and on Slurm."""
    if not n_jobs:
        return f"{path}: no job is left"
    file = shlex.quote(str(path))
    wrapped = shlex.quote(f'sh -c "$(sed -n ${{SLURM_ARRAY_TASK_ID}}p {file})"')
    return (
        f"{path}: {n_jobs} commands. One a core on this machine:\n"
        f"  tr '\\n' '\\0' < {file} | xargs -0 -P $(nproc) -n 1 sh -c\n"
        "or on Slurm:\n"
        f"  sbatch --array=1-{n_jobs} --cpus-per-task=1 --mem=4G --time=1-0 --wrap {wrapped}"
    )
