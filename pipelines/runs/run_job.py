"""Doing runs: the stages of each in order, and those that several runs make together."""

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

from pipelines.config.methods import EXTRA_STAGES
from pipelines.engine.job import (
    Job,
    disk_errors_explained,
    do_stage,
    failure,
    withdraw_config,
    write_config,
    write_summary,
)
from pipelines.engine.stage import Stage, has_files, run_stage_together, stage_status
from pipelines.engine.store import read_json
from pipelines.engine.wrapping import columns, fitted
from pipelines.errors import ConfigError
from pipelines.runs.below_random import warning_below_random
from pipelines.runs.derived import derive, opened_run
from pipelines.runs.imitation import advice
from pipelines.runs.result import show_result
from pipelines.runs.stage_table import stages_of
from pipelines.runs.summary import summarise
from pipelines.tracking.tracker import Tracker


@dataclass(frozen=True)
class RunJob(Job):
    """A run: its configuration is a `RunConfig`."""

    program = "otr-run"
    ends_with = "evaluate"

    oracle: "RunJob | None" = None  # the job that trains the network to imitate; None for a method without an oracle

    @property
    def stages(self) -> tuple[Stage, ...]:
        stages = stages_of(self.config.method.name, polished=self.config.is_polished)
        return tuple(stages[name] for name in self.config.selected_stages)

    def side_by_side(self) -> Self:
        """Return a job for which, as for its oracle's, others share its terminal and its cores."""
        oracle = self.oracle.side_by_side() if self.oracle else None
        return dataclasses.replace(super().side_by_side(), oracle=oracle)

    @property
    def needed(self) -> set[str]:
        """The files that its stages need of the oracle's actor, though archives leave them out."""
        return {name for stage in self.stages if stage.needs for name in stage.needs(stage.of(self.config))}

    @property
    def lacks_oracle(self) -> bool:
        """Whether its oracle has to be trained or imported, again where it is kept without a file that is needed."""
        if self.oracle is None:
            return False
        refers = any(
            s.is_of_other_job and stage_status(s, self.run_dir / s.name, self.config) != "done" for s in self.stages
        )
        return refers or not has_files(self.oracle.run_dir / self.oracle.stages[0].name, self.needed)

    def found_done(self) -> None:
        """Log the run where it is tracked: tracking may have been added later."""
        if self.ends_with in self.config.selected_stages and self.config.tracking != "none":
            with opened_run(self.config, self.run_dir) as whole:
                Tracker(self.config).finish(read_json(whole / "summary.json"), whole)


def run_job(job: RunJob) -> dict[str, Any] | None:
    """Do the missing stages of a run, print its results, and return its summary; None where it stops before the end."""
    with disk_errors_explained(job):
        return _run_stages(job)


def run_jobs(jobs: Sequence[RunJob]) -> list[Exception | None]:
    """Do jobs one after the other, what several make together first; return what each failed with."""
    made = {each[0].folder: each for each in map(_made_together, jobs) if each}
    errors: dict[str, Exception | None] = {}
    try:
        if len(made) > 1:
            fleet, stage = [job for job, _ in made.values()], next(iter(made.values()))[1]
            with disk_errors_explained(fleet[0]):
                errors = dict(zip(made, _make_together(stage, fleet), strict=True))
    except Exception as error:  # of all of them, such as a full disk
        return [error] * len(jobs)
    return [errors.get((job.oracle or job).folder) or failure(run_job, job) for job in jobs]


def _made_together(job: RunJob) -> tuple[RunJob, Stage] | None:
    """Return the stage that a job, or the one before it, may make with those of others; None where there is none."""
    for stage in job.stages:
        if stage.is_of_other_job and job.oracle:
            return _made_together(job.oracle)
        if stage.together:
            return job, stage
    return None


def _make_together(stage: Stage, jobs: Sequence[RunJob]) -> list[Exception | None]:
    """Make a stage of several jobs as one, as far as they need it; `run_job` then finds each one's done."""
    missing = [job for job in jobs if _is_missing(stage, job)]
    for job in missing:
        print(f"{job.run_dir}", flush=True)
        job.run_dir.mkdir(parents=True, exist_ok=True)
        write_config(job)
    if missing and stage.announce:
        stage.announce([stage.of(job.config) for job in missing])
    return run_stage_together(stage, [(job.run_dir, job.config) for job in jobs])


def _is_missing(stage: Stage, job: RunJob) -> bool:
    return stage_status(stage, job.run_dir / stage.name, job.config) == "missing"


def _run_stages(job: RunJob, needed: Collection[str] = ()) -> dict[str, Any] | None:
    """Do the missing stages of a run; of an oracle's, the first again where it is kept without a `needed` file."""
    config, run_dir = job.config, job.run_dir
    print(f"{run_dir}", flush=True)
    run_dir.mkdir(parents=True, exist_ok=True)
    for stage in job.stages:
        if stage.is_of_other_job and job.oracle and job.lacks_oracle:
            _run_stages(job.oracle, job.needed)
            print(f"{run_dir}", flush=True)
        is_missing = _is_missing(stage, job)
        if not is_missing and not has_files(run_dir / stage.name, needed):
            print(f"{stage.name}: kept without {', '.join(sorted(needed))}, as archives are; done again", flush=True)
            is_missing = True
        if stage.announce and is_missing:
            stage.announce([stage.of(config)])
        if stage.checkpoints:
            write_config(job)
        try:
            do_stage(job, stage, partial(derive, config), needed)
        except ConfigError:
            withdraw_config(job)
            raise
    if job.ends_with not in config.selected_stages:
        return None
    summary = summarise(config, run_dir)
    write_summary(job, summary)
    unasked = {extra for extra in EXTRA_STAGES if extra not in config.selected_stages}
    with opened_run(config, run_dir) as whole:
        shown = {key: value for key, value in summary.items() if key not in unasked}
        show_result(shown, run_dir, whole, config.env)
        for text in (warning_below_random(config, summary), advice(config, shown, job.overrides)):
            if text:
                print(fitted(text, columns()))
        Tracker(config).finish(summary, whole)
    return summary
