"""What a sweep would do: run, resume or skip for every job, and the time that is left."""

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from pipelines.console import duration
from pipelines.run import RunJob
from pipelines.stage import stage_status
from pipelines.stages import STAGES
from pipelines.training import estimated_seconds, trained_steps


def job_plan(job: RunJob) -> tuple[str, float]:
    """Return what is to be done for a job, in words, and the seconds of training it leaves."""
    config = job.config
    statuses = {name: stage_status(STAGES[name], job.run_dir / name, config) for name in config.selected_stages}
    if "other settings" in statuses.values():
        names = [name for name, status in statuses.items() if status == "other settings"]
        return f"refused: {', '.join(names)} there has other settings", 0.0
    left = [name for name, status in statuses.items() if status != "done"]
    if not left:
        return "skip", 0.0
    if "train" not in left:
        return f"run {', '.join(left)}", 0.0
    done = trained_steps(config)
    seconds = estimated_seconds(config)
    return (f"resume at step {done:,}" if done else "run"), seconds


def print_plan(jobs: Sequence[RunJob]) -> None:
    """Print one line a job and the sum."""
    table = Table("job", "plan", "time", box=None)
    total, n_skipped = 0.0, 0
    for job in jobs:
        what, seconds = job_plan(job)
        total += seconds
        n_skipped += what == "skip"
        table.add_row(job.folder, what, duration(seconds) if seconds else "")
    console = Console(highlight=False, soft_wrap=True)
    console.print(table)
    console.print(
        f"{len(jobs)} jobs: {n_skipped} to skip, {len(jobs) - n_skipped} left, about {duration(total)} of one core"
    )
