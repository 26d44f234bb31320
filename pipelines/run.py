"""One run: its stages in order and its summary."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipelines.config import RunConfig
from pipelines.console import duration, show_result
from pipelines.errors import PipelineError
from pipelines.job import Job, disk_errors_explained
from pipelines.stage import Stage, StageResult, run_stage, run_stage_together, stage_status
from pipelines.stages import STAGES
from pipelines.store import read_csv, read_json, write_json, write_text
from pipelines.tracking import open_tracker
from pipelines.training import checkpoint_folder, estimated_bytes, estimated_seconds, trained_steps

LONG_RUN_S = 60.0
SUMMARY_SCHEMA = "otr/summary/1"


class RunJob(Job):
    """A run: its configuration is a `RunConfig`."""

    @property
    def stages(self) -> tuple[Stage, ...]:
        """The stages that are asked for, in order."""
        return tuple(STAGES[name] for name in self.config.selected_stages)

    @property
    def ends_with(self) -> str:
        """The stage after which the run's summary is written."""
        return "evaluate"

    def found_done(self) -> None:
        """Show the run to the tracker, which may be younger than the run."""
        if self.ends_with in self.config.selected_stages:
            open_tracker(self.config).finish(read_json(self.run_dir / "summary.json"), self.run_dir)


def run_job(job: RunJob) -> dict[str, Any] | None:
    """Do what is not done of a run, print what came out, and return its summary; None where it stops before the end."""
    with disk_errors_explained(job):
        return _run_stages(job)


def run_jobs(jobs: Sequence[RunJob]) -> list[Exception | None]:
    """Do jobs one after the other, those of one fleet after training them as one; return what each failed with."""
    together = len(jobs) > 1 and all("train" in job.config.selected_stages for job in jobs)
    try:
        errors = _train_together(jobs) if together else [None] * len(jobs)
    except Exception as error:  # of the whole fleet, such as a full disk
        return [error] * len(jobs)
    return [error or _failure(job) for job, error in zip(jobs, errors, strict=True)]


def _failure(job: RunJob) -> Exception | None:
    try:
        run_job(job)
    except Exception as error:
        return error
    return None


def _train_together(jobs: Sequence[RunJob]) -> list[Exception | None]:
    """Train the runs of a fleet as one, as far as they need it; `run_job` then finds each one's training done."""
    from pipelines.fleet.train import train_fleet  # imports torch

    missing = [job for job in jobs if stage_status(STAGES["train"], job.run_dir / "train", job.config) == "missing"]
    for job in missing:
        print(f"{job.run_dir}", flush=True)
        job.run_dir.mkdir(parents=True, exist_ok=True)
    if missing:
        _announce_training([job.config for job in missing])

    def train(
        inputs: Sequence[Mapping[str, Path]], configs: Sequence[RunConfig], outs: Sequence[Path]
    ) -> Sequence[Exception | None]:
        return train_fleet(configs, outs)

    return run_stage_together(STAGES["train"], [(job.run_dir, job.config) for job in jobs], train)


def _run_stages(job: RunJob) -> dict[str, Any] | None:
    config, run_dir = job.config, job.run_dir
    print(f"{run_dir}", flush=True)
    run_dir.mkdir(parents=True, exist_ok=True)
    results: dict[str, StageResult] = {}
    for name in config.selected_stages:
        stage = STAGES[name]
        if name == "train" and stage_status(stage, run_dir / name, config) == "missing":
            _announce_training([config])
        results[name] = run_stage(stage, run_dir, config, job.command)
        if name == "train":  # only now that the result is in its place
            shutil.rmtree(checkpoint_folder(config), ignore_errors=True)
        if not (run_dir / "config.yaml").exists():
            write_text(run_dir / "config.yaml", job.config_yaml)
        print(_stage_line(name, results[name]), flush=True)
    if "evaluate" not in results:
        return None
    summary = summarise(job)
    write_json(run_dir / "summary.json", summary)
    (run_dir / "error.log").unlink(missing_ok=True)
    show_result(summary, run_dir)
    open_tracker(config).finish(summary, run_dir)
    return summary


def summarise(job: RunJob) -> dict[str, Any]:
    """Return a finished run's summary from its stages' reports."""
    config, run_dir = job.config, job.run_dir
    mapped, pruned, evaluated = (read_json(run_dir / name / "report.json") for name in ("map", "prune", "evaluate"))
    manifests = {name: read_json(run_dir / name / "manifest.json") for name in ("train", "map", "prune", "evaluate")}
    # The manifest knows the last process alone; a resumed training spent the sum of its segments at least.
    segments_s = sum(float(row["seconds"]) for row in read_csv(run_dir / "train" / "progress.csv"))
    trained_s = round(max(segments_s, manifests["train"]["seconds"]), 3)
    return {
        "schema": SUMMARY_SCHEMA,
        "env": config.env.name,
        "task": config.env.task,
        "env_id": config.env.id,
        "method": config.method.name,
        "depth": config.depth,
        "budget": config.budget.name,
        "trainer": config.trainer_name,
        "algorithm": config.algo.name,
        "seed": config.seed,
        "steps": config.train.steps,
        **evaluated["policies"]["tree"],
        "n_leaves": mapped["n_leaves"],
        "pruned_leaves": pruned["n_leaves"],
        "pruned_depth": pruned["pruned_depth"],
        "patterns": pruned["patterns"],
        "fidelity": evaluated["fidelity"],
        "policies": evaluated["policies"],
        "seconds": {name: manifest["seconds"] for name, manifest in manifests.items()} | {"train": trained_s},
        "versions": manifests["evaluate"]["versions"],
    }


def _announce_training(configs: Sequence[RunConfig]) -> None:
    """Print the likely time and disk of a long training, of one run or a fleet; refuse what cannot fit on the disk."""
    config = configs[0]
    left = [max(0, each.train.steps - trained_steps(each)) for each in configs]
    seconds = sum(estimated_seconds(each) for each in configs)
    n_bytes = sum(estimated_bytes(each) * n // each.train.steps for each, n in zip(configs, left, strict=True))
    folder = Path(config.results_dir)
    free = shutil.disk_usage(folder).free
    if n_bytes > free:
        raise PipelineError(
            f"{folder}: training needs about {n_bytes / 1e6:,.0f} MB for checkpoints, {free / 1e6:,.0f} MB are free\n"
            "Choose another place with results_dir=PATH, or a smaller algo.buffer_size."
        )
    if seconds >= LONG_RUN_S:
        runs = f"{len(configs)} runs as one, " if len(configs) > 1 else ""
        where = "on one GPU" if config.fleet and config.fleet.device == "cuda" else "on one core"
        print(
            f"train: {runs}{sum(left):,} steps of {config.algo.name.upper()}, about {duration(seconds)} {where}, "
            f"up to {max(1, round(n_bytes / 1e6))} MB of checkpoints; Ctrl-C stops, the same command goes on",
            flush=True,
        )


def _stage_line(name: str, result: StageResult) -> str:
    how = f"done before, {duration(result.seconds)}" if result.skipped else duration(result.seconds)
    return f"{name}: {how}"
