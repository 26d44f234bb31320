"""The certificates of finished runs as one table: what is proved of which policy, where, and in what time."""

from decimal import ROUND_CEILING, Context
from itertools import groupby
from pathlib import Path
from typing import Any

from pipelines.engine.store import corrupt, read_json, write_csv, write_text
from pipelines.report.table_cells import METHODS, TASKS, beyond_order
from pipelines.report.table_text import markdown_table

CSV_COLUMNS = ("env", "method", "depth", "budget", "seed", "certified", "domain", "paths", "leaves",
               "max_error", "linear_programs", "find_s", "prove_s", "check_s", "reason")  # fmt: skip
CELL = ("env", "method", "depth", "budget", "certified", "domain", "reason")
NOTES = (
    "Proved: at every real point of the domain the minimal tree is the trained network, up to the error: a bound on "
    "the difference of any affine output, found in rational arithmetic. An error of 0 means the same function.",
    "Paths: of the full tree. Leaves: of the minimal one. Both are ranges where runs differ.",
    "The environment's box is gymnasium's observation space; the box around the states of episodes is stated in each "
    "run's certify/report.json.",
    "Seconds: to find the tree, to prove it, to check the proof without a solver; on whatever machine the run was on.",
    "`otr-run ... certify=true` adds a certificate to a finished run, `otr-verify run=FOLDER` checks it again. The CSV "
    "has a line for every run.",
)


def write_certificates(results_dir: Path) -> list[Path]:
    """Write `certificates.md` and `certificates.csv` under `results_dir/tables` from the runs that have one.

    Left out are smoke budgets and runs with other settings (`seed-<s>~<digest>`). The same runs give the same bytes.

    Raises:
        PipelineError: a run's summary cannot be read; names the file.
    """
    rows = [_row(path) for path in sorted(results_dir.glob("runs/*/*/depth-*/*/seed-*/summary.json")) if _counts(path)]
    certificates = sorted((row for row in rows if row), key=_order)
    folder = results_dir / "tables"
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"certificates.{ending}" for ending in ("md", "csv")]
    write_text(paths[0], _markdown(certificates))
    write_csv(paths[1], certificates, CSV_COLUMNS)
    return paths


def _counts(path: Path) -> bool:
    return "~" not in path.parent.name and not path.parent.parent.name.startswith("smoke")


def _row(path: Path) -> dict[str, Any]:
    """Return the line of one run, by CSV_COLUMNS; empty where it has no certificate."""
    try:
        return _read(path, read_json(path))
    except KeyError as error:
        raise corrupt(path, error) from error


def _read(path: Path, summary: dict[str, Any]) -> dict[str, Any]:
    report = summary.get("certify")
    if report is None:
        return {}
    seconds = report.get("seconds", {})
    return {
        "env": str(summary["env"]),
        "method": str(summary["method"]).replace("_", "-"),
        "depth": path.parts[-4].removeprefix("depth-"),
        "budget": path.parts[-3],
        "seed": summary["seed"],
        "certified": report["certified"],
        "domain": report["domain"],
        "paths": summary["n_leaves"],
        "leaves": report.get("n_leaves", ""),
        "max_error": report.get("max_error", ""),
        "linear_programs": report.get("n_linear_programs", ""),
        **{f"{short}_s": seconds.get(name, "") for short, name in
           (("find", "minimal_tree"), ("prove", "certify"), ("check", "verify"))},
        "reason": report.get("reason", ""),
    }  # fmt: skip


def _order(row: dict[str, Any]) -> tuple[Any, ...]:
    return (
        *beyond_order((row["env"], row["method"], row["depth"])),
        row["budget"],
        *(str(row[key]) for key in CELL[4:]),
        row["seed"],
    )


def _markdown(rows: list[dict[str, Any]]) -> str:
    """Return the table, a line for the runs that differ in their seed alone, and the notes."""
    lines = [["Task", "Method", "Depth", "Budget", "Runs", "Paths", "Leaves", "Proved on", "Error at most",
              "Seconds: find", "prove", "check"]]  # fmt: skip
    for cell, group in groupby(rows, key=lambda row: [row[key] for key in CELL]):
        (env, method, depth, budget, certified, domain, reason), runs = cell, list(group)
        names = [TASKS.get(env, env), METHODS.get(method, method), depth, budget, str(len(runs))]
        paths = _range([run["paths"] for run in runs])
        if not certified:
            lines.append([*names, paths, "", f"not proved: {reason}", "", "", "", ""])
            continue
        error = _rounded_up(max(run["max_error"] for run in runs))
        leaves = _range([run["leaves"] for run in runs])
        times = [f"{max(run[f'{step}_s'] for run in runs):.2f}" for step in ("find", "prove", "check")]
        lines.append([*names, paths, leaves, domain, error, *times])
    title = "# Certificates: what is proved of the trained policies"
    notes = "\n".join(f"* {note}" for note in NOTES)
    return "\n\n".join((title, markdown_table(lines) if rows else "No run has a certificate yet.", notes)) + "\n"


def _rounded_up(bound: float) -> str:
    """Return a bound with one digit, which is not below it."""
    return str(Context(prec=1, rounding=ROUND_CEILING).create_decimal_from_float(bound)).lower()


def _range(values: list[int]) -> str:
    least, greatest = min(values), max(values)
    return f"{least:,}" if least == greatest else f"{least:,} to {greatest:,}"
