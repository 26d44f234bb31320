"""Return against steps and CPU-seconds: the curves of the committed runs of Hopper at depth 6, as one picture.

A curve is the return of the actor that a run would hand out if it ended there: the best so far of its evaluations on
selection episodes. Of each trainer the runs with the most steps are shown.

    python -m benchmarks.search_curves     redraws the picture with the rates in results/benchmarks/search.json
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

import otr
from benchmarks.measure import output_dir, results_dir
from pipelines.cli.runs import load_config
from pipelines.config.algo import SacConfig
from pipelines.engine.store import read_csv, read_json
from pipelines.report import load_runs
from pipelines.report.figures.style import (
    NORMAL,
    OF_LINES,
    SMALL,
    figure_of_panels,
    legend_line,
    line_styles,
    set_legend,
)
from pipelines.training.estimates import learning_starts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRAINERS = {"ars": "direct search", "sb3": "SAC, Stable-Baselines3", "fleet": "SAC, fleet"}
ALGORITHMS = ("ars", "sac")
RATES = "Hopper, depth 6: direct search"  # the entries of search.json with the rates, and the peer
PEERS = {"sb3": "Stable-Baselines3 SAC, one run", "fleet": "fleet's SAC, ten runs"}


def main() -> None:
    """Redraw the picture."""
    argparse.ArgumentParser(
        "benchmarks.search_curves", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    entries = [entry for entry in read_json(output_dir(quick=False) / "search.json") if entry["name"] == RATES]
    rates = {"ars": entries[0]["value"]}
    by_peer = {entry["peer"]: entry["peer_value"] for entry in entries}
    rates |= {trainer: by_peer[peer] for trainer, peer in PEERS.items()}
    for path in write_picture(results_dir(), rates, output_dir(quick=False)):
        print(path)


def write_picture(results_dir: Path, rates: Mapping[str, float], folder: Path) -> list[Path]:
    """Write search.png and search.svg into `folder`; nothing where there is no run.

    Args:
        results_dir: where the runs are.
        rates: environment steps a CPU-second by trainer.
        folder: made where it is not there.
    """
    runs = shown_runs(load_runs(results_dir))
    if runs.empty:
        print(f"search: no picture, because {results_dir}/runs/hopper/otr has no finished runs of depth 6", flush=True)
        return []
    labelled = []
    for trainer, own in runs.groupby("trainer", sort=False):
        for _, run in own.iterrows():
            made = curve(results_dir / "runs" / run["run"], rates[str(trainer)])
            labelled.append(made.assign(label=label(own, rates[str(trainer)]), seed=run["seed"]))
    curves = pd.concat(labelled, ignore_index=True)
    figure = return_against_cost(curves, "Hopper-v4, depth 6: the best actor so far (thick: the mean of the runs)")
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / "search.png", folder / "search.svg"]
    for path in paths:
        otr.save_picture(figure, path)
    return paths


def return_against_cost(curves: pd.DataFrame, title: str) -> "Figure":
    """Return a figure of the return that training reaches against its environment steps and its CPU-seconds.

    Thin lines are single runs, a thick one is the mean of a label's runs, from where each has a value to where the
    first ends. Labels come in the order of the curves.

    Args:
        curves: at least one row for each time that a run was judged: `label` (who trains, in words), `seed` (which run
            of these), `steps`, `seconds` (rows of 0 have no place there) and `best` (the best return so far, which
            stays until the next row).
        title: of the figure.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    if curves.empty:
        raise ValueError("no curves were given")
    styles = line_styles(curves["label"])
    costs = {"steps": "environment steps", "seconds": "CPU-seconds of one core"}
    ticks = {"steps": [1.0], "seconds": [1.0, 3.0]}  # within a decade
    names = pd.DataFrame({"panel": ["by steps", "by time"]})
    figure, panels = figure_of_panels(
        names, 2, 2, ("", "return of the best policy so far"), len(styles), share=(False, True)
    )
    for panel, cost in zip(panels, costs, strict=True):
        for label, style in styles.items():
            _draw_curves(panel, curves[(curves["label"] == label) & (curves[cost] > 0)], cost, style)
        panel.set_xscale("log")
        panel.set_xlabel(f"{costs[cost]} (log scale)", fontsize=SMALL)
        panel.xaxis.set_major_locator(LogLocator(subs=ticks[cost]))
        panel.xaxis.set_minor_formatter(NullFormatter())
        for axis in (panel.xaxis, panel.yaxis):
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        panel.set_ylim(bottom=0)
    figure.suptitle(title, fontsize=NORMAL)
    set_legend(figure, [legend_line(label, linewidth=1.8, **style) for label, style in styles.items()], 1, OF_LINES)
    return figure


def _draw_curves(panel: "Axes", curves: pd.DataFrame, cost: str, style: dict[str, Any]) -> None:
    runs = [run.set_index(cost)["best"] for _, run in curves.groupby("seed")]
    style = style | {"drawstyle": "steps-post"}
    if len(runs) == 1:
        panel.plot(runs[0].index, runs[0], linewidth=1.8, **style)
        return
    for run in runs:
        panel.plot(run.index, run, linewidth=0.7, alpha=0.45, **style)
    mean = pd.concat(runs, axis=1).sort_index().ffill().loc[: min(run.index[-1] for run in runs)].dropna().mean(axis=1)
    panel.plot(mean.index, mean, linewidth=1.8, **style)


def shown_runs(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of `load_runs` that have a curve, in the order of TRAINERS."""
    hopper = runs[(runs["env"] == "hopper") & (runs["method"] == "otr") & (runs["depth"] == "6")]
    trained = hopper[(hopper["form"] == "tree") & hopper["algorithm"].isin(ALGORITHMS)]
    groups = []
    for trainer in TRAINERS:
        own = trained[trained["trainer"] == trainer]
        kinds = [kind for _, kind in own.groupby(["budget", "settings"])]
        groups += [max(kinds, key=lambda kind: kind["steps"].max())] if kinds else []
    return pd.concat(groups) if groups else trained


def curve(run_dir: Path, rate: float) -> pd.DataFrame:
    """Return a run's curve: steps, CPU-seconds at `rate` without SAC's random first steps, best return so far."""
    rows = read_csv(run_dir / "train" / "evaluations.csv")
    steps, returns = (np.array([float(row[name]) for row in rows]) for name in ("steps", "return_mean"))
    config = load_config(run_dir, None)
    n_random = learning_starts(config) if isinstance(config.algo, SacConfig) else 0
    seconds = np.maximum(steps - n_random, 0) / rate
    return pd.DataFrame({"steps": steps, "seconds": seconds, "best": np.maximum.accumulate(returns)})


def label(runs: pd.DataFrame, rate: float) -> str:
    """Return what the legend says of a trainer's runs."""
    n, steps = len(runs), int(runs["steps"].iloc[0])
    amount = f"{n} run{'s' if n > 1 else ''} of {steps:,} steps at {rate:,.0f} steps/s"
    reported = f"return {runs['return_mean'].mean():,.0f} on 100 other episodes"
    return f"{TRAINERS[runs['trainer'].iloc[0]]}: {amount}; {reported}"


if __name__ == "__main__":
    main()
