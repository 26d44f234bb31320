"""One run: its stages in order and its summary."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.config import RunConfig
from pipelines.config.methods import EXTRA_STAGES
from pipelines.engine.console import duration, show_result
from pipelines.engine.job import Job, disk_errors_explained
from pipelines.engine.stage import Stage, StageResult, run_stage, run_stage_together, stage_status
from pipelines.engine.store import read_csv, read_json, write_json, write_text
from pipelines.errors import PipelineError
from pipelines.stages.imitation import working_folder
from pipelines.stages.table import STAGES, stages_of
from pipelines.tracking.tracker import open_tracker
from pipelines.training.estimates import checkpoint_folder, estimated_bytes, estimated_seconds, trained_steps

LONG_RUN_S = 60.0


@dataclass(frozen=True)
class RunJob(Job):
    """A run: its configuration is a `RunConfig`.

    Attributes:
        oracle: the job that trains the network to imitate; None for a method without an oracle.
    """

    oracle: "RunJob | None" = None

    @property
    def stages(self) -> tuple[Stage, ...]:
        """The stages that are asked for, in order."""
        stages = stages_of(self.config.method.name)
        return tuple(stages[name] for name in self.config.selected_stages)

    @property
    def trained(self) -> "RunJob":
        """The job whose stage train this one needs: the oracle's, or its own."""
        return self.oracle or self

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
    trained = {job.trained.folder: job.trained for job in jobs if _trains(job)}
    errors: dict[str, Exception | None] = {}
    try:
        if len(trained) > 1:
            errors = dict(zip(trained, _train_together(list(trained.values())), strict=True))
    except Exception as error:  # of the whole fleet, such as a full disk
        return [error] * len(jobs)
    return [errors.get(job.trained.folder) or _failure(job) for job in jobs]


def _trains(job: RunJob) -> bool:
    """Return whether a job asks for training, its own or its oracle's."""
    return not {"train", "oracle"}.isdisjoint(job.config.selected_stages)


def _failure(job: RunJob) -> Exception | None:
    try:
        run_job(job)
    except Exception as error:
        return error
    return None


def _train_together(jobs: Sequence[RunJob]) -> list[Exception | None]:
    """Train the runs of a fleet as one, as far as they need it; `run_job` then finds each one's training done."""
    from pipelines.training.fleet.train import train_fleet  # imports torch

    missing = [job for job in jobs if stage_status(STAGES["train"], job.run_dir / "train", job.config) == "missing"]
    for job in missing:
        print(f"{job.run_dir}", flush=True)
        job.run_dir.mkdir(parents=True, exist_ok=True)
    if missing:
        _announce_training([job.config for job in missing])

    def train(
        inputs: Sequence[Mapping[str, Path]], configs: Sequence[RunConfig], outs: Sequence[Path]
    ) -> Sequence[Exception | None]:
        return train_fleet(configs, [checkpoint_folder(config) for config in configs], outs)

    return run_stage_together(STAGES["train"], [(job.run_dir, job.config) for job in jobs], train)


def _run_stages(job: RunJob) -> dict[str, Any] | None:
    config, run_dir = job.config, job.run_dir
    print(f"{run_dir}", flush=True)
    run_dir.mkdir(parents=True, exist_ok=True)
    results: dict[str, StageResult] = {}
    for stage in job.stages:
        name = stage.name
        if name == "oracle" and job.oracle and stage_status(stage, run_dir / name, config) != "done":
            _run_stages(job.oracle)
            print(f"{run_dir}", flush=True)
        if name == "train" and stage_status(stage, run_dir / name, config) == "missing":
            _announce_training([config])
        results[name] = run_stage(stage, run_dir, config, job.command)
        if name == "train":  # only now that the result is in its place
            shutil.rmtree(checkpoint_folder(config), ignore_errors=True)
        if name == "imitate":
            shutil.rmtree(working_folder(config, run_dir / "oracle"), ignore_errors=True)
        if not (run_dir / "config.yaml").exists():
            write_text(run_dir / "config.yaml", job.config_yaml)
        print(_stage_line(name, results[name]), flush=True)
    if "evaluate" not in results:
        return None
    summary = summarise(job)
    write_json(run_dir / "summary.json", summary)
    (run_dir / "error.log").unlink(missing_ok=True)
    unasked = {extra for extra in EXTRA_STAGES if extra not in config.selected_stages}
    show_result({key: value for key, value in summary.items() if key not in unasked}, run_dir)
    open_tracker(config).finish(summary, run_dir)
    return summary


def summarise(job: RunJob) -> dict[str, Any]:
    """Return a finished run's summary from its stages' reports."""
    config, run_dir = job.config, job.run_dir
    names = config.method.stages
    made, pruned, evaluated = (
        read_json(run_dir / name / "report.json") for name in (config.method.tree_stage, "prune", "evaluate")
    )
    extras = tuple(extra for extra in EXTRA_STAGES if (run_dir / extra / "manifest.json").is_file())
    manifests = {name: read_json(run_dir / name / "manifest.json") for name in (*names, *extras)}
    seconds = {name: manifest["seconds"] for name, manifest in manifests.items()}
    if "train" in seconds:
        # The manifest knows the last process alone; a resumed training spent the sum of its segments at least.
        segments_s = sum(float(row["seconds"]) for row in read_csv(run_dir / "train" / "progress.csv"))
        seconds["train"] = round(max(segments_s, seconds["train"]), 3)
    summary = {
        "schema": config.summary_schema,
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
        "n_leaves": made["n_leaves"],
        "pruned_leaves": pruned["n_leaves"],
        "pruned_depth": pruned["pruned_depth"],
        "patterns": pruned["patterns"],
        "fidelity": evaluated["fidelity"],
        "policies": evaluated["policies"],
        "seconds": seconds,
        "versions": manifests["evaluate"]["versions"],
    }
    if "imitate" in names:
        summary["oracle"] = {"hidden_widths": list(config.oracle), **evaluated["oracle"]}
        summary["imitate"] = {name: made[name] for name in ("round", "n_rows", "n_steps")}
    if "n_outside_domain" in evaluated:
        summary |= {name: evaluated[name] for name in ("n_outside_domain", "n_states")}
    if "parse" in names:
        summary |= {"program": made["program"], "algorithm": "none", "steps": 0}
    return summary | {extra: read_json(run_dir / extra / "report.json") for extra in extras}


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
        print(
            f"train: {runs}{sum(left):,} steps of {config.algo.name.upper()}, about {duration(seconds)} on one core, "
            f"up to {max(1, round(n_bytes / 1e6))} MB of checkpoints; Ctrl-C stops, the same command goes on",
            flush=True,
        )


def _stage_line(name: str, result: StageResult) -> str:
    how = f"done before, {duration(result.seconds)}" if result.skipped else duration(result.seconds)
    return f"{name}: {how}"
