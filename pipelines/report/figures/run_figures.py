"""The figures of `otr-tabulate` that show the runs that one names: learning curves, and leaves kept."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import otr
from pipelines.engine.store import ARCHIVE, CONFIG, exists
from pipelines.errors import ConfigError
from pipelines.report.figures.learning_curves import learning_curves, load_curves
from pipelines.report.figures.leaves_kept import load_leaves, return_against_leaves
from pipelines.runs.finished_run import check_run, find_folder, find_run, with_its_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_curves(runs: Sequence[str], out: str | None, results_dir: Path) -> list[Path]:
    """Write the learning curves of runs, or of all runs below folders, as PNG, or as what `out` ends in."""
    curves = load_curves(runs_below(runs, results_dir))
    return _written(learning_curves(curves), "curves", runs, out, results_dir)


def write_leaves(runs: Sequence[str], out: str | None, results_dir: Path) -> list[Path]:
    """Write the return of runs, or of all runs below folders, against the leaves kept, and the numbers as CSV."""
    points = load_leaves(runs_below(runs, results_dir))
    (picture,) = _written(return_against_leaves(points), "leaves", runs, out, results_dir)
    points.to_csv(picture.with_suffix(".csv"), index=False, lineterminator="\n")
    return [picture, picture.with_suffix(".csv")]


RUN_FIGURES = {"curves": write_curves, "leaves": write_leaves}


def runs_below(runs: Sequence[str], results_dir: Path) -> list[Path]:
    """Return the folders of runs, or of all runs below folders, as given or below `results_dir/runs`, each once."""
    return list(dict.fromkeys(folder for run in runs or [""] for folder in _below(run, results_dir)))


def _below(run: str, results_dir: Path) -> list[Path]:
    check_run(run)
    folder = find_folder(run, results_dir)
    places = {path.parent for name in (CONFIG, ARCHIVE) for path in folder.rglob(name)} if folder else set()
    found = sorted(with_its_names(place) for place in places if exists(place / CONFIG))
    below = [path for path in found if path.parts[-3].startswith("depth-")]  # a fit's has another name there
    return below or [find_run(run, str(results_dir))]


def _below_runs(run: str, results_dir: Path) -> str:
    """Return the path of a folder of runs below `runs`, or its name where it is elsewhere."""
    folder = os.path.normpath((find_folder(run, results_dir) or Path(run)).absolute())
    _, runs, below = f"{folder}/".rpartition("/runs/")
    return below.strip("/") if runs else Path(folder).name


def _written(figure: "Figure", name: str, runs: Sequence[str], out: str | None, results_dir: Path) -> list[Path]:
    place = os.path.commonpath([_below_runs(run, results_dir) for run in runs]).replace("/", "-") or "several"
    path = Path(out) if out else results_dir / "figures" / f"{name}-{place}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        otr.save_picture(figure, path)
    except ValueError as error:
        raise ConfigError(f"out={out}: {error}") from error
    return [path]
