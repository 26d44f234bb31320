"""Sweeps: the jobs of a command, group by group, under the launcher that its overrides name."""

import itertools
import os
import time
from collections.abc import Sequence
from pathlib import Path

from pipelines.cli.overrides import quoted
from pipelines.cli.workflow import Workflow
from pipelines.engine.console import show_rows
from pipelines.engine.job import disk_errors_explained
from pipelines.engine.store import read_summary
from pipelines.engine.sweep import GroupTask, Outcome, run_sweep
from pipelines.errors import ConfigError

# What a job depends on outside of its configuration; a cluster's processes have not inherited it. No secrets here: they
# would be written to disk.
CARRIED_VARIABLES = ("OTR_RESULTS_DIR", "OTR_DATA_DIR", "XDG_DATA_HOME")


def do_sweep(workflow: Workflow, overrides: Sequence[str]) -> bool:
    """Do every job of a sweep and return whether all are done; failing ones do not stop the others and are named."""
    jobs = workflow.jobs(workflow.expand(overrides, multirun=True))
    if not jobs:
        raise ConfigError("these overrides make no job; look for an empty range()")
    workflow.check(jobs[0].config)
    name, carried = sweep_name(), {variable: os.environ.get(variable) for variable in CARRIED_VARIABLES}

    def launch(left: Sequence[int]) -> list[Outcome]:
        chosen = [jobs[i] for i in left]
        groups = workflow.groups([job.config for job in chosen])
        tasks = [
            GroupTask([chosen[i] for i in group], workflow.do_group, name, str(Path.cwd()), carried) for group in groups
        ]
        # Absolute, because Hydra makes this folder in whatever folder a launcher starts the job.
        folder = Path(chosen[0].config.results_dir).absolute() / "sweeps"
        with disk_errors_explained(chosen[0]):
            folder.mkdir(parents=True, exist_ok=True)
        # The launcher's settings are the same for all jobs; those of the first are used, as swept keys have no default.
        returned = workflow.launch(tasks, [*chosen[0].overrides, f"hydra.sweep.dir={quoted(str(folder))}"])
        outcomes = dict(zip(itertools.chain(*groups), itertools.chain(*returned), strict=True))
        return [outcomes[i] for i in range(len(chosen))]

    outcomes = run_sweep(jobs, launch)
    failed = [outcome for outcome in outcomes if outcome.error]
    rows = {
        job.folder.removeprefix("runs/"): workflow.row(summary)
        for job, outcome in zip(jobs, outcomes, strict=True)
        if job.ends and not outcome.error and (summary := read_summary(job.run_dir))
    }
    if rows:
        print()
        show_rows("job", rows)
    print(f"\n{len(outcomes)} jobs: {len(outcomes) - len(failed)} done, {len(failed)} failed")
    for outcome in failed:
        print(f"  {outcome.folder}: {outcome.error}")
        if outcome.traceback:
            print(f"    traceback: {outcome.traceback}")
    return not failed


def sweep_name() -> str:
    """Return the name of the folder for the failures of the current sweep."""
    return time.strftime("%Y-%m-%d_%H-%M-%S")
