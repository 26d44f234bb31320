"""The reports that `otr-tabulate` writes from finished runs and fits: tables, figures, and all runs or fits as CSV."""

import difflib
from collections.abc import Callable
from pathlib import Path

import pandas as pd

from pipelines.config.run import RunConfig
from pipelines.engine.store import SUMMARY, exists
from pipelines.errors import ConfigError
from pipelines.report.certificates import write_certificates
from pipelines.report.comparisons import write_comparisons
from pipelines.report.equal_steps import write_equal_steps
from pipelines.report.figures.figure_4_6 import budget_of_runs, write_figure_4_6
from pipelines.report.figures.figure_4_7 import write_figure_4_7
from pipelines.report.figures.numbers import write_numbers
from pipelines.report.figures.performance_profile import write_performance_profile
from pipelines.report.frames import load_fits, load_runs
from pipelines.report.table_4_1 import write_table_4_1
from pipelines.report.table_4_2 import write_table_4_2
from pipelines.report.text import page, write_tables

FIGURES_OF_A_BUDGET = ("4.6", "4.7")
FIGURES = (*FIGURES_OF_A_BUDGET, "profile", "numbers")
FIGURES_OF_RUNS = ("curves", "leaves", "regions")  # `pipelines.report.figures.run_figures` writes them
ALL = ("4.2", "4.6", "4.7", "certificates", "comparisons", "equal_steps", "profile", "numbers", "4.1")


def reports_of(asked: str) -> tuple[str, ...]:
    """Return the reports that `all`, a report's name, `table=NAME` or `figure=NAME` stands for."""
    kind, equals, name = asked.rpartition("=")
    known = {
        "table": (*TABLES,),
        "figure": (*FIGURES, *FIGURES_OF_RUNS),
        "": ("all", *TABLES, *FIGURES, *FIGURES_OF_RUNS),
    }[kind]
    if name not in known:
        close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        hint = f" Did you mean {kind}{equals}{close[0]}?" if close else ""
        raise ConfigError(f"{asked} is not known.{hint} Known {kind or 'report'}s: {', '.join(known)}")
    return ALL if name == "all" else (name,)


def write_report(
    name: str, results_dir: Path, budget: str | None, load_config: Callable[[Path], RunConfig]
) -> list[Path]:
    """Write a report under `results_dir/tables` or `results_dir/figures`; the same runs give the same bytes.

    Args:
        name: of the report, as `reports_of` returns it.
        results_dir: the folder that holds `runs`; a table of runs that are not there says "not run".
        budget: whose runs a figure shows; None for the thesis's if there are any, else quick.
        load_config: from a run's folder to the configuration that it was made with.

    Returns:
        What was written: the text first, then its CSV and its LaTeX, then pictures.

    Raises:
        PipelineError: a run's summary cannot be read; names the file.
        MissingInputError: nothing has been run of what a figure needs; names the command.
    """
    if name in TABLES:
        return TABLES[name](results_dir)
    runs = load_runs(results_dir)
    if name in ("profile", "numbers"):
        return {"profile": write_performance_profile, "numbers": write_numbers}[name](results_dir, runs)
    budget = budget or budget_of_runs(runs)
    if name == "4.6":
        return write_figure_4_6(runs, budget, results_dir)
    return write_figure_4_7(runs, budget, load_config, results_dir)


def write_runs(results_dir: Path) -> list[Path]:
    """Write all runs, a row a run and form of its policy, as CSV, and what its columns are as Markdown."""
    return _write_frame(results_dir, "runs", load_runs(results_dir), "runs/*/*/depth-*/*/seed-*")


def write_fits(results_dir: Path) -> list[Path]:
    """Write all fits, a row each, as CSV, and what its columns are as Markdown."""
    return _write_frame(results_dir, "fits", load_fits(results_dir), "runs/*/*/seed-*", "runs/*/*/split-*/seed-*")


TABLES: dict[str, Callable[[Path], list[Path]]] = {
    "4.1": write_table_4_1,
    "4.2": write_table_4_2,
    "certificates": write_certificates,
    "comparisons": write_comparisons,
    "equal_steps": write_equal_steps,
    "runs": write_runs,
    "fits": write_fits,
}


def _write_frame(results_dir: Path, name: str, frame: pd.DataFrame, *folders: str) -> list[Path]:
    """Write a frame, what its columns are, and which folders have no row."""
    found = sorted(path for pattern in folders for path in results_dir.glob(pattern))
    left_out = [path for path in found if not exists(path / SUMMARY)]
    named = ", ".join(str(path.relative_to(results_dir / "runs")) for path in left_out) or "none"
    markdown = page(f"{name}.md", n_rows=len(frame), n_folders=frame["run"].nunique(), left_out=named)
    return write_tables(results_dir, name, frame, markdown)
