"""What a sweep would do: run, resume or skip for every job, and the time left."""

from collections.abc import Collection, Sequence
from contextlib import suppress

from pipelines.engine.archive import MANIFEST
from pipelines.engine.console import counted, duration
from pipelines.engine.job import has_summary
from pipelines.engine.stage import Stage, has_files, stage_key, stage_status
from pipelines.engine.store import exists
from pipelines.engine.wrapping import columns, fitted
from pipelines.errors import PipelineError
from pipelines.runs.run_job import RunJob
from pipelines.stages.train import TRAIN, seconds_left, trained_steps


def job_plan(job: RunJob, planned: set[str]) -> tuple[str, float]:
    """Return what is left to do for a job, as text, and its seconds of training, imitating and polishing.

    `planned` has the folders of the oracles that jobs before it train; its own is added.
    """
    statuses = {stage.name: _status(job, stage) for stage in job.stages}
    if "other settings" in statuses.values():
        names = [name for name, status in statuses.items() if status == "other settings"]
        return f"refused: {', '.join(names)} there has other settings", 0.0
    left = [name for name, status in statuses.items() if status != "done"]
    if not left:
        return ("skip" if has_summary(job) else "write the summary"), 0.0
    likely = {stage.name: stage.seconds_left(stage.of(job.config)) for stage in job.stages
              if stage.seconds_left and stage.name in left}  # fmt: skip
    seconds = sum(likely.values())
    polished = f", polish for about {duration(likely['polish'])}" if "polish" in left else ""
    if "train" in left:
        done = trained_steps(TRAIN.of(job.config))
        return (f"resume at step {done:,}" if done else "run") + polished, seconds
    if job.oracle and job.lacks_oracle:
        what, oracle_seconds = _oracle_plan(job.oracle, planned, job.needed)
        return f"run, {what}{polished}", seconds + oracle_seconds
    return f"run {', '.join(left)}", seconds


def _status(job: RunJob, stage: Stage) -> str:
    """Return a stage's status, by its inputs where these exist and are whole."""
    inputs, wanted = {name: job.run_dir / name for name in stage.inputs}, None
    if all(exists(folder / MANIFEST) for folder in inputs.values()):
        with suppress(PipelineError):  # damaged: doing the job reports what is wrong
            wanted = stage_key(stage, job.config, inputs)
    return stage_status(stage, job.run_dir / stage.name, job.config, wanted)


def _oracle_plan(oracle: RunJob, planned: set[str], needed: Collection[str]) -> tuple[str, float]:
    """Return what becomes of a job's oracle and the seconds that it takes; jobs that share one train it once."""
    name, stage = oracle.folder.removeprefix("runs/"), oracle.stages[0]
    folder = oracle.run_dir / stage.name
    if stage_status(stage, folder, oracle.config) == "done" and has_files(folder, needed):
        return f"oracle {name} is there", 0.0
    if not oracle.config.is_trained:
        return f"import oracle {name}", 0.0
    if oracle.folder in planned:
        return f"oracle {name} as above", 0.0
    planned.add(oracle.folder)
    settings = TRAIN.of(oracle.config)
    done = trained_steps(settings)
    how = f"resume at step {done:,}" if done else "train"
    return f"{how} oracle {name}", seconds_left(settings)


def print_plan(jobs: Sequence[RunJob]) -> None:
    """Print one line a job and the sum."""
    rows = [("job", "plan", "time")]
    total, n_skipped = 0.0, 0
    planned: set[str] = set()
    for job in counted(jobs, "jobs planned"):
        what, seconds = job_plan(job, planned)
        total += seconds
        n_skipped += what == "skip"
        rows.append((job.folder, what, duration(seconds) if seconds else ""))
    print(plan_lines(rows, columns()))
    jobs_in_all = f"{len(jobs)} job{'s' * (len(jobs) != 1)}"
    print(f"{jobs_in_all}: {n_skipped} to skip, {len(jobs) - n_skipped} left, about {duration(total)} of one core")


def plan_lines(rows: Sequence[tuple[str, str, str]], width: int) -> str:
    """Return rows as lines: three columns where they fit into the width, else what is planned below each job."""
    folders, plans = (max(len(row[i]) for row in rows) for i in (0, 1))
    lines = [f"{folder:<{folders}}  {plan:<{plans}}  {time}".rstrip() for folder, plan, time in rows]
    if max(map(len, lines)) > width:
        lines = [f"{folder}\n    {', '.join(filter(None, (plan, time)))}" for folder, plan, time in rows[1:]]
    return fitted("\n".join(lines), width)
