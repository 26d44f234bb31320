"""Shrink: the minutes from a finished oracle to a small policy at 90 % of its return, per task.

Nothing is run: every run under results/runs (OTR_RESULTS_DIR for another folder) that was polished by critics has kept
how long its imitation took (on the clock) and when each of its candidates had played (seconds of CPU, the selection
episodes included). 90 % is on the way from random actions (`pipelines/random_returns.csv`) to the oracle's return over
the evaluation episodes; a candidate's return is that over the selection episodes. The oracle's training is not counted.

An entry has the mean of the minutes over the seeds that got there, and says how many did; another the polished return
over the evaluation episodes against the oracle's.

Target: none is set.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.measure import Entry, results_dir
from pipelines.engine.store import read_csv, read_summary
from pipelines.runs.below_random import random_returns

SHARE = 0.9


@dataclass(frozen=True)
class ShrunkRun:
    """A polish by critics: the minutes to a return of SHARE, None where no candidate got there."""

    group: str
    minutes: float | None
    after: float
    oracle: float


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick makes no difference, as nothing is run."""
    place = results_dir() / "runs"
    runs: dict[str, list[ShrunkRun]] = {}
    for path in sorted(place.glob("*/*/depth-*/*/*/summary.json")):
        summary = read_summary(path.parent)
        if summary.get("polish", {}).get("by") == "critic" and "oracle" in summary["policies"]:
            run = shrunk_run(path.parent, summary, str(path.parent.parent.relative_to(place)))
            runs.setdefault(run.group, []).append(run)
    if not runs:
        print(f"shrink: no run under {place} was polished by critics: otr-run ... polish=true polishing.by=critic")
    return [entry for group, own in runs.items() for entry in group_entries(group, own)]


def shrunk_run(run_dir: Path, summary: dict[str, Any], group: str) -> ShrunkRun:
    """Read what a run has kept of its way."""
    oracle = float(summary["policies"]["oracle"]["return_mean"])
    least = random_returns()[summary["task"]]
    rows = read_csv(run_dir / "polish" / "candidates.csv")
    seconds = summary["polish"]["candidate_seconds"]
    means = [(float(row["selection_mean"]) - least) / (oracle - least) for row in rows]
    there = next((second for mean, second in zip(means, seconds, strict=True) if mean >= SHARE), None)
    minutes = None if there is None else (summary["seconds"]["imitate"] + there) / 60
    return ShrunkRun(group, minutes, float(summary["polish"]["return_mean"]), oracle)


def group_entries(group: str, runs: Sequence[ShrunkRun]) -> list[Entry]:
    """Return the entries of runs that differ in the seed alone."""
    there = [run.minutes for run in runs if run.minutes is not None]
    after, oracle = (sum(getattr(run, what) for run in runs) / len(runs) for what in ("after", "oracle"))
    entries = [Entry(f"{group}: return of {len(runs)} runs", after, "return", "oracle", oracle, clock=None)]
    if there:
        what = f"{group}: to {SHARE:.0%} of the oracle, {len(there)} of {len(runs)} runs"
        entries.insert(0, Entry(what, sum(there) / len(there), "minutes"))
    return entries
