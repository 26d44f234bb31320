"""The figures of `otr-tabulate` that show the runs that one names: curves, leaves kept, and maps of regions."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import otr
from pipelines.config.run import RunConfig
from pipelines.engine.store import ARCHIVE, CONFIG, exists
from pipelines.errors import ConfigError
from pipelines.play.printed_programs import names_of_env
from pipelines.report.figures.learning_curves import curve_rows, learning_curves, load_curves
from pipelines.report.figures.leaves_kept import load_leaves, return_against_leaves
from pipelines.report.figures.regions import chosen_inputs, draw_regions
from pipelines.report.text import csv_text, write_file
from pipelines.runs.finished_run import (
    check_run,
    find_folder,
    find_run,
    title_of,
    tree_of,
    visited_states,
    with_its_names,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class RunFigure:
    """What a figure shows: runs, or for curves and leaves any folders with runs below, and what is left open."""

    run: Sequence[str]
    tree: str = "pruned"
    inputs: Sequence[str] = field(default_factory=list)
    out: str | None = None


def write_curves(asked: RunFigure, results_dir: Path, load_config: Callable[[Path], RunConfig]) -> list[Path]:
    """Write the learning curves of runs, or of all runs below folders, as a picture and as CSV, or as CSV alone."""
    curves = load_curves(runs_below(asked.run, results_dir))
    table = csv_text(curve_rows(curves))
    if asked.out and asked.out.endswith(".csv"):
        return [write_file(Path(asked.out), table)]
    (picture,) = _written(learning_curves(curves), "curves", asked, results_dir)
    return [picture, write_file(picture.with_suffix(".csv"), table)]


def write_leaves(asked: RunFigure, results_dir: Path, load_config: Callable[[Path], RunConfig]) -> list[Path]:
    """Write the return of runs, or of all runs below folders, against the leaves kept, and the numbers as CSV."""
    points = load_leaves(runs_below(asked.run, results_dir))
    (picture,) = _written(return_against_leaves(points), "leaves", asked, results_dir)
    points.to_csv(picture.with_suffix(".csv"), index=False, lineterminator="\n")
    return [picture, picture.with_suffix(".csv")]


def write_regions(asked: RunFigure, results_dir: Path, load_config: Callable[[Path], RunConfig]) -> list[Path]:
    """Write the map of a run's tree over two inputs as PNG, or as what `out` ends in."""
    if len(asked.run) > 1:
        raise ConfigError(f"run={','.join(asked.run)}: figure=regions is of one run; name one")
    folder = find_run("".join(asked.run), str(results_dir))
    config = load_config(folder)
    tree = tree_of(asked.tree, config, folder)
    if not isinstance(tree, otr.ObliqueTree):
        raise ConfigError(f"tree={asked.tree}: it is held as activation patterns; use tree=pruned")
    states, names = visited_states(config, tree), names_of_env(tree, config.env)
    inputs = chosen_inputs(tree, states, names["feature_names"], asked.inputs)
    title = title_of(config, asked.tree)
    return _written(draw_regions(tree, states, inputs, **names, title=title), "regions", asked, results_dir)


RUN_FIGURES = {"curves": write_curves, "leaves": write_leaves, "regions": write_regions}


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


def _written(figure: "Figure", name: str, asked: RunFigure, results_dir: Path) -> list[Path]:
    place = os.path.commonpath([_below_runs(run, results_dir) for run in asked.run]).replace("/", "-") or "several"
    path = Path(asked.out) if asked.out else results_dir / "figures" / f"{name}-{place}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        otr.save_picture(figure, path)
    except ValueError as error:
        raise ConfigError(f"out={asked.out}: {error}") from error
    return [path]
