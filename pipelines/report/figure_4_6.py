"""Figure 4.6: return of imitating trees on the lander against their depth, a panel for each oracle."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import otr
from pipelines.config import RunConfig
from pipelines.engine.store import corrupt, read_json, write_csv
from pipelines.report.figures import DepthPoint, return_against_depth
from pipelines.report.table_cells import METHODS, SUMMARY_SCHEMA, bootstrap_interval

COLUMNS = ("oracle", "method", "depth", "mean", "std", "ci_low", "ci_high", "n_runs", "n_episodes", "budget",
           "oracle_mean", "note")  # fmt: skip
SOLVED = 200.0  # the thesis: an average return above it over 100 consecutive episodes
ENVIRONMENT = "lunarlander"


@dataclass(frozen=True)
class DepthCell:
    """The runs of one oracle, method and depth.

    Attributes:
        oracle: hidden widths, as `[64,64]`.
        method: as the tables name it.
        depth: of the tree.
        returns: mean return of each finished run.
        n_planned: runs that the experiment has.
        n_episodes: fewest episodes of a run.
        oracle_mean: mean over the oracle's runs, those of every method and depth; None where nothing was run.
    """

    oracle: str
    method: str
    depth: int
    returns: tuple[float, ...]
    n_planned: int
    n_episodes: int | None
    oracle_mean: float | None

    @property
    def mean(self) -> float | None:
        """The mean over runs."""
        return statistics.fmean(self.returns) if self.returns else None

    @property
    def std(self) -> float | None:
        """The sample standard deviation (n - 1) over runs; None with fewer than two."""
        return statistics.stdev(self.returns) if len(self.returns) > 1 else None

    @property
    def note(self) -> str:
        """What is missing."""
        if not self.returns:
            return "not run"
        return "" if len(self.returns) == self.n_planned else f"{len(self.returns)} of {self.n_planned} runs"


def write_figure_4_6(runs: Sequence[RunConfig], results_dir: Path) -> list[Path]:
    """Write Figure 4.6 under `results_dir/figures` from those of the experiment's runs that are finished.

    The same runs give the same bytes.

    Args:
        runs: the experiment's runs, finished or not, all under one budget.
        results_dir: the folder that holds them.

    Returns:
        The CSV, the PNG and the SVG file; the CSV alone where nothing was run.

    Raises:
        PipelineError: a run's summary cannot be read; names the file.
    """
    cells = depth_cells(runs, results_dir)
    folder = results_dir / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    budget = runs[0].budget_level
    paths = [folder / "figure_4_6.csv"]
    write_csv(paths[0], [_csv_row(cell, budget) for cell in cells], COLUMNS)
    points = [
        DepthPoint(cell.oracle, _name(cell.method), cell.depth, cell.mean, cell.std, cell.oracle_mean)
        for cell in cells
        if cell.mean is not None
    ]
    if points:
        figure = return_against_depth(points, SOLVED, f"LunarLander: {_runs_text(cells)}, budget {budget}")
        for ending in ("png", "svg"):
            paths.append(folder / f"figure_4_6.{ending}")
            otr.save_picture(figure, paths[-1])
    return paths


def depth_cells(runs: Sequence[RunConfig], results_dir: Path) -> list[DepthCell]:
    """Return the cells in the order of the runs, unfinished ones included."""
    summaries = {run.folder: _summary(results_dir / run.folder / "summary.json", run) for run in runs}
    oracles: dict[str, dict[int, float]] = {}
    groups: dict[tuple[str, str, int], list[dict[str, Any] | None]] = {}
    for run in runs:
        summary, oracle = summaries[run.folder], _oracle_text(run)
        groups.setdefault((oracle, run.method.name.replace("_", "-"), run.depth), []).append(summary)
        if summary:  # every method and depth of a seed has the same oracle, on the same episodes
            oracles.setdefault(oracle, {})[run.seed] = summary["policies"]["oracle"]["return_mean"]
    oracle_means = {oracle: statistics.fmean(means.values()) for oracle, means in oracles.items()}
    cells = []
    for (oracle, method, depth), planned in groups.items():
        done = [summary for summary in planned if summary]
        returns = tuple(float(summary["return_mean"]) for summary in done)
        n_episodes = min((int(summary["n_episodes"]) for summary in done), default=None)
        cells.append(DepthCell(oracle, method, depth, returns, len(planned), n_episodes, oracle_means.get(oracle)))
    return cells


def _name(method: str) -> str:
    """Return a method's name in the legend; NDPS's depth leaves out the tests of the argmax below its affine leaves."""
    return "NDPS (affine leaves)" if method == "ndps" else METHODS[method]


def _summary(path: Path, run: RunConfig) -> dict[str, Any] | None:
    """Return a run's summary; None where there is none.

    Raises:
        PipelineError: it is broken, or of another run than the one that is looked for.
    """
    if not path.is_file():
        return None
    summary: dict[str, Any] = read_json(path)
    try:
        found = [
            summary["schema"],
            summary["method"],
            summary["depth"],
            summary["seed"],
            summary["oracle"]["hidden_widths"],
        ]
        expected = [SUMMARY_SCHEMA, run.method.name, run.depth, run.seed, list(run.oracle)]
        if found != expected:
            raise ValueError(f"it is of schema, method, depth, seed and oracle {found}, expected {expected}")
        _ = summary["return_mean"] + summary["policies"]["oracle"]["return_mean"] + summary["n_episodes"]
    except KeyError as error:
        raise corrupt(path, ValueError(f"it has no {error}")) from error
    except (TypeError, ValueError) as error:
        raise corrupt(path, error) from error
    return summary


def _csv_row(cell: DepthCell, budget: str) -> dict[str, Any]:
    """Return a cell under COLUMNS; what there is not is empty. Six decimals hide how a platform adds up."""
    low, high = bootstrap_interval(cell.returns) or (None, None)
    numbers = {"mean": cell.mean, "std": cell.std, "ci_low": low, "ci_high": high, "oracle_mean": cell.oracle_mean}
    return {
        "oracle": cell.oracle,
        "method": cell.method,
        "depth": cell.depth,
        **{name: None if value is None else round(value, 6) for name, value in numbers.items()},
        "n_runs": len(cell.returns),
        "n_episodes": cell.n_episodes,
        "budget": budget,
        "note": cell.note,
    }


def _oracle_text(run: RunConfig) -> str:
    return str(list(run.oracle)).replace(" ", "")


def _runs_text(cells: Sequence[DepthCell]) -> str:
    counts = sorted({len(cell.returns) for cell in cells if cell.returns})
    number = str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    return f"mean ± standard deviation over {number} run{'' if counts == [1] else 's'}"
