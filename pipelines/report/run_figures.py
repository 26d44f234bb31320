"""The figures of `otr-tabulate` that show the runs that one names: learning curves, and maps of regions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import otr
from pipelines.config.run import RunConfig
from pipelines.errors import ConfigError
from pipelines.report.learning_curves import learning_curves, load_curves
from pipelines.report.regions import chosen_inputs, draw_regions
from pipelines.runs.export import check_run, find_run, title_of, tree_of, visited_states
from pipelines.stages.printed_programs import names_of_env

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class RunFigure:
    """What a figure shows: a run, or for curves any folder with runs below, and what is left open."""

    run: str
    tree: str = "pruned"
    inputs: Sequence[str] = field(default_factory=list)
    out: str | None = None


def write_curves(asked: RunFigure, results_dir: Path, load_config: Callable[[Path], RunConfig]) -> list[Path]:
    """Write the learning curves of a run, or of all runs below a folder, as PNG, or as what `out` ends in."""
    runs = runs_below(asked.run, results_dir)
    return _written(learning_curves(load_curves(runs)), "curves", asked, results_dir)


def write_regions(asked: RunFigure, results_dir: Path, load_config: Callable[[Path], RunConfig]) -> list[Path]:
    """Write the map of a run's tree over two inputs as PNG, or as what `out` ends in."""
    folder = find_run(asked.run, str(results_dir))
    config = load_config(folder)
    tree = tree_of(asked.tree, config, folder)
    if not isinstance(tree, otr.ObliqueTree):
        raise ConfigError(f"tree={asked.tree}: it is held as activation patterns; use tree=pruned")
    states, names = visited_states(config, tree), names_of_env(tree, config.env)
    inputs = chosen_inputs(tree, states, names["feature_names"], asked.inputs)
    title = title_of(config, asked.tree)
    return _written(draw_regions(tree, states, inputs, **names, title=title), "regions", asked, results_dir)


RUN_FIGURES = {"curves": write_curves, "regions": write_regions}


def runs_below(run: str, results_dir: Path) -> list[Path]:
    """Return the folder of a run, or those of all runs below a folder, as given or below `results_dir/runs`."""
    check_run(run)
    tried = [Path(run), results_dir / run, results_dir / "runs" / run]
    folder = next((path for path in tried if path.is_dir()), None)
    below = sorted(path.parent for path in folder.rglob("config.yaml")) if folder else []
    return below or [find_run(run, str(results_dir))]


def _written(figure: "Figure", name: str, asked: RunFigure, results_dir: Path) -> list[Path]:
    place = asked.run.rstrip("/").rpartition("runs/")[2].replace("/", "-")
    path = Path(asked.out) if asked.out else results_dir / "figures" / f"{name}-{place}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        otr.save_picture(figure, path)
    except ValueError as error:
        raise ConfigError(f"out={asked.out}: {error}") from error
    return [path]
