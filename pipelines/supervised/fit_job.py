"""Fits: their stages in order, seeds together where the learner trains them so, and their summaries."""

import dataclasses
import shutil
from collections.abc import Sequence
from typing import Any

from pipelines.engine.archive import MANIFEST, read_manifest
from pipelines.engine.digests import digest
from pipelines.engine.job import Job, disk_errors_explained, do_stage, failure, is_done, write_summary
from pipelines.engine.stage import Stage, run_stage, run_stage_together
from pipelines.engine.store import SUMMARY, exists, read_json
from pipelines.supervised.config import FitConfig
from pipelines.supervised.fit import FIT
from pipelines.supervised.learners import BATCHED
from pipelines.supervised.result import show_fit
from pipelines.supervised.score import SCORE
from pipelines.supervised.teacher import TEACHER
from pipelines.supervised.tune import TUNE


def stages_of(config: FitConfig) -> tuple[Stage, ...]:
    """Return the stages that are asked for, in order."""
    fit, teacher = (
        dataclasses.replace(each, inputs=("tune",) if config.method.grid else ()) for each in (FIT, TEACHER)
    )
    return tuple(stage for stage in (TUNE, fit, teacher, SCORE) if stage.name in config.selected_stages)


class FitJob(Job):
    """A fit: its configuration is a `FitConfig`."""

    program = "otr-fit"
    ends_with = "score"

    @property
    def stages(self) -> tuple[Stage, ...]:
        return stages_of(self.config)


def fit_groups(configs: Sequence[FitConfig]) -> list[list[int]]:
    """Return the positions of the fits that one process does, those that differ in their seed alone."""
    groups: dict[str, list[int]] = {}
    for i, config in enumerate(configs):
        key = digest([config.settings() | {"seed": None}, config.results_dir])
        groups.setdefault(key, []).append(i)
    size = configs[0].seeds_per_process if configs else 1
    return sorted(group[start : start + size] for group in groups.values() for start in range(0, len(group), size))


def fit_job(job: FitJob) -> dict[str, Any] | None:
    """Do the missing stages of a fit, print its results, and return its summary; None where it stops before the end."""
    print(f"{job.run_dir}", flush=True)
    if is_done(job):
        print("done before", flush=True)
        if job.config.keep_trees and not (job.run_dir / "fit").is_dir():
            print("its trees were not kept; stages=[fit] fits them again", flush=True)
    else:
        with disk_errors_explained(job):
            _run_stages(job)
    if job.stages[-1].name != job.ends_with:
        return None
    summary: dict[str, Any] = read_json(job.run_dir / SUMMARY)
    show_fit(summary, job.run_dir)
    return summary


def fit_jobs(jobs: Sequence[FitJob]) -> list[Exception | None]:
    """Do fits that differ in their seed alone, networks as one batched model; return what each failed with."""
    left = [job for job in jobs if not is_done(job)]
    try:
        if len(left) > 1 and left[0].config.method.learner in BATCHED:
            with disk_errors_explained(left[0]):
                _fit_together(left)
    except Exception as error:  # of all of them
        return [error if job in left else None for job in jobs]
    return [failure(fit_job, job) for job in jobs]


def _fit_together(jobs: Sequence[FitJob]) -> None:
    """Bring the trees of several seeds up to date at once; `fit_job` then finds them done."""
    for stage in jobs[0].stages:
        if stage.name == "tune":
            for job in jobs:
                run_stage(stage, job.run_dir, job.config, job.command)
        elif stage.name == "fit":
            print(f"{jobs[0].run_dir} and {len(jobs) - 1} more seeds as one batched model", flush=True)
            for job in jobs:
                job.run_dir.mkdir(parents=True, exist_ok=True)
            run_stage_together(stage, [(job.run_dir, job.config) for job in jobs])


def _run_stages(job: FitJob) -> None:
    for stage in job.stages:
        do_stage(job, stage)
    if job.stages[-1].name == job.ends_with:
        write_summary(job, summarise(job))
        if not job.config.keep_trees:
            shutil.rmtree(job.run_dir / "fit")


def summarise(job: FitJob) -> dict[str, Any]:
    """Return a finished fit's summary from its stages' reports."""
    config: FitConfig = job.config
    names = [name for name in config.all_stages if exists(job.run_dir / name / MANIFEST)]
    manifests = {name: read_manifest(job.run_dir / name) for name in names}
    return {
        "schema": config.summary_schema,
        "data": config.data.name,
        **({} if config.data.split is None else {"split": config.data.split}),
        "method": config.method.name,
        "learner": config.method.learner,
        "seed": config.seed,
        **read_json(job.run_dir / "score" / "report.json"),
        **({"teacher": read_json(job.run_dir / "teacher" / "report.json")} if "teacher" in names else {}),
        "seconds": {name: manifest["seconds"] for name, manifest in manifests.items()},
        "versions": manifests["score"]["versions"],
    }
