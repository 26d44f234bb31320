"""The figures that are drawn from the control runs, one row each, and which runs they show."""

import difflib
from collections.abc import Callable, Sequence
from pathlib import Path

from pipelines.config import RunConfig
from pipelines.errors import ConfigError
from pipelines.report.figure_4_6 import ENVIRONMENT, write_figure_4_6
from pipelines.report.figure_4_7 import write_figure_4_7

EXPERIMENT = "figure_4_6"  # whose runs both figures show
FIGURES: dict[str, Callable[[Sequence[RunConfig], Path], list[Path]]] = {
    "4.6": write_figure_4_6,
    "4.7": write_figure_4_7,
}
# Words that name the part of the experiment that a figure shows.
RUNS_OF_FIGURE: dict[str, tuple[str, ...]] = {"4.6": (), "4.7": ("method=augtree", "depth=2")}
BUDGETS = ("thesis", "quick")


def check_figure(figure: str) -> None:
    """Raise ConfigError, with the figures there are, for one that is not known."""
    if figure not in FIGURES:
        close = difflib.get_close_matches(figure, FIGURES, n=1, cutoff=0.5)
        hint = f" Did you mean figure={close[0]}?" if close else ""
        raise ConfigError(f"figure={figure} is not known.{hint} Known figures: {', '.join(FIGURES)}")


def budget_of_runs(results_dir: Path) -> str:
    """Return the first of BUDGETS under which a tree has imitated an oracle on the lander; the last where none has."""
    methods = ("augtree", "viper", "ndps")
    for budget in BUDGETS:
        found = (results_dir.glob(f"runs/{ENVIRONMENT}/{name}/depth-*/{budget}/*/summary.json") for name in methods)
        if any(True for paths in found for _ in paths):
            return budget
    return BUDGETS[-1]
