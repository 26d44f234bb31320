"""Figures from runs and fits; `otr.save_picture` writes them. matplotlib is loaded when one is drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

__all__ = ["DepthPoint", "FigurePoint", "auc_against_leaves", "return_against_depth"]

PANEL_WIDTH, PANEL_HEIGHT, LEGEND_ROW = 3.4, 2.35, 0.2  # inches
SMALL, NORMAL = 8, 9  # points
MOST_TICKS = 6
DATA_LABELS = {"bace": "Bace", "hiv": "HIV", "sider": "SIDER", "tox21": "Tox21", "pdbbind": "PDBbind"}
# Okabe & Ito's colours without yellow, which colour-blind people tell apart; with 8 markers there are 56 pairs.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#444444")
MARKERS = (("o", 5.5), ("s", 5.0), ("^", 6.0), ("D", 5.0), ("v", 6.0), ("<", 6.0), (">", 6.0), ("p", 6.5))  # and sizes
GREY = "#666666"
INK = "#1a1a1a"
DASHES, DOTS, HOLLOW_LARGER = (0, (5, 3)), (0, (1, 2)), 3  # points


@dataclass(frozen=True)
class FigurePoint:
    """One cell of Table 4.2.

    Attributes:
        data: data set, as `load_dataset` takes it.
        method: what tells methods apart; each has a colour and a marker.
        method_label: the method in words.
        leaves: number of leaves that states reach, at least 1; a mean over runs need not be whole.
        auc: of the test part, mean over runs.
        auc_std: standard deviation over runs; None for a single run.
        published: the thesis's number, if it has one.
    """

    data: str
    method: str
    method_label: str
    leaves: float
    auc: float
    auc_std: float | None = None
    published: float | None = None


@dataclass(frozen=True)
class DepthPoint:
    """One point of Figure 4.6.

    Attributes:
        oracle: the network that was imitated, in words; each has a panel.
        method_label: the method in words; each has a colour and a marker.
        depth: of the tree.
        mean: return, mean over runs.
        std: standard deviation over runs; None for a single run.
        oracle_mean: the oracle's own return; None where it is not known.
    """

    oracle: str
    method_label: str
    depth: int
    mean: float
    std: float | None = None
    oracle_mean: float | None = None


def return_against_depth(points: Sequence[DepthPoint], solved: float, title: str | None = None) -> Figure:
    """Return a figure of what depth buys: return against a tree's depth, a panel for each oracle.

    Bands are one standard deviation to either side; a dashed line is the oracle's own return, a dotted one the return
    from which the problem counts as solved. Panels, and methods in the legend, come in the order of the points.

    Raises:
        ValueError: there are no points.
    """
    from matplotlib.figure import Figure

    if not points:
        raise ValueError("no points were given")
    oracles = list(dict.fromkeys(point.oracle for point in points))
    styles = _styles([point.method_label for point in points])
    n_columns = min(len(oracles), 2)
    n_panel_rows = math.ceil(len(oracles) / n_columns)
    height = PANEL_HEIGHT * n_panel_rows + LEGEND_ROW * 2
    figure = Figure(figsize=(PANEL_WIDTH * max(n_columns, 1.5), height), layout="constrained", facecolor="white")
    panels = figure.subplots(n_panel_rows, n_columns, squeeze=False, sharex=True, sharey=True)
    for panel, oracle in zip(panels.flat, oracles, strict=False):
        _draw_depths(panel, [point for point in points if point.oracle == oracle], styles, solved)
        panel.set_title(f"oracle {oracle}", fontsize=NORMAL, fontweight="bold", loc="left")
    for panel in panels.flat[len(oracles) :]:
        panel.set_visible(False)
    panels[0, 0].set_xticks(sorted({point.depth for point in points}))
    for panel in panels.flat[max(len(oracles) - n_columns, 0) : len(oracles)]:
        panel.set_xlabel("depth of the tree", fontsize=SMALL)
    for panel in panels[:, 0]:
        panel.set_ylabel("return", fontsize=SMALL)
    if title:
        figure.suptitle(title, fontsize=NORMAL)
    handles = _depth_legend(points, styles, solved)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=len(handles),
        frameon=False, fontsize=SMALL, handletextpad=0.4, columnspacing=1.4,
    )  # fmt: skip
    return figure


def auc_against_leaves(rows: Sequence[FigurePoint], title: str | None = None) -> Figure:
    """Return a figure of what leaves buy: test AUC against their number, a panel for each data set.

    Bars are one standard deviation to either side; hollow markers are the thesis's numbers, put at the leaves that
    were reached here; a dashed line is the score of a single leaf, which is the linear model. Panels, and methods in
    the legend, come in the order of the rows.

    Raises:
        ValueError: there are no rows, or one has less than 1 leaf.
    """
    from matplotlib.figure import Figure

    wrong = next((row for row in rows if not row.leaves >= 1), None)
    if wrong is not None or not rows:
        raise ValueError(f"{wrong or 'no rows were given'}; expected rows with at least 1 leaf")
    data_sets = list(dict.fromkeys(row.data for row in rows))
    styles = _styles([row.method for row in rows])
    n_columns = len(data_sets) if len(data_sets) < 3 else 2 if len(data_sets) == 4 else 3
    n_panel_rows = math.ceil(len(data_sets) / n_columns)
    handles = _legend(rows, styles)
    n_legend_columns = min(len(handles), 2 * n_columns)
    height = PANEL_HEIGHT * n_panel_rows + LEGEND_ROW * (math.ceil(len(handles) / n_legend_columns) + 1)
    figure = Figure(figsize=(PANEL_WIDTH * n_columns, height), layout="constrained", facecolor="white")
    panels = figure.subplots(n_panel_rows, n_columns, squeeze=False, sharex=True)
    for panel, data in zip(panels.flat, data_sets, strict=False):
        _draw_panel(panel, [row for row in rows if row.data == data], styles)
        panel.set_title(DATA_LABELS.get(data, data), fontsize=NORMAL, fontweight="bold", loc="left")
    for panel in panels.flat[len(data_sets) :]:
        panel.set_visible(False)
    _set_ticks(panels[0, 0], rows)
    for panel in panels.flat[max(len(data_sets) - n_columns, 0) : len(data_sets)]:
        panel.set_xlabel("leaves reached (log scale)", fontsize=SMALL)
    for panel in panels[:, 0]:
        panel.set_ylabel("test AUC", fontsize=SMALL)
    if title:
        figure.suptitle(title, fontsize=NORMAL + 2, fontweight="bold")
    figure.legend(
        handles=handles, loc="outside lower center", ncols=n_legend_columns,
        frameon=False, fontsize=SMALL, handletextpad=0.4, columnspacing=1.4,
    )  # fmt: skip
    return figure


def _styles(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return colour and marker of every method, in the order in which they first come."""
    styles = {}
    for i, method in enumerate(dict.fromkeys(methods)):
        marker, size = MARKERS[i % len(MARKERS)]
        styles[method] = {"color": COLOURS[i % len(COLOURS)], "marker": marker, "markersize": size}
    return styles


def _draw_panel(panel: Axes, rows: Sequence[FigurePoint], styles: dict[str, dict[str, Any]]) -> None:
    for row in rows:
        if row.leaves == 1:
            panel.axhline(row.auc, color=styles[row.method]["color"], linestyle=DASHES, linewidth=1, zorder=1)
    for method, style in styles.items():
        points = sorted((row for row in rows if row.method == method), key=lambda row: row.leaves)
        if len(points) > 1:
            leaves, scores = [row.leaves for row in points], [row.auc for row in points]
            panel.plot(leaves, scores, color=style["color"], linewidth=1, alpha=0.6, zorder=2)
        for row in points:
            # The hollow marker is the larger one, so that it shows around the filled one where the two agree.
            if row.published is not None:
                hollow = {**style, "markersize": style["markersize"] + HOLLOW_LARGER, "markerfacecolor": "none"}
                panel.plot([row.leaves], [row.published], linestyle="none", markeredgewidth=1, zorder=3, **hollow)
            panel.errorbar(
                [row.leaves], [row.auc], yerr=row.auc_std, linestyle="none", elinewidth=1, capsize=2.5,
                markeredgecolor="white", markeredgewidth=0.5, zorder=4, **style,
            )  # fmt: skip
    panel.set_xscale("log", base=2)
    panel.locator_params(axis="y", nbins=5)
    _dress(panel)


def _draw_depths(panel: Axes, points: Sequence[DepthPoint], styles: dict[str, dict[str, Any]], solved: float) -> None:
    panel.axhline(solved, color=GREY, linestyle=DOTS, linewidth=1, zorder=1)
    means = [point.oracle_mean for point in points if point.oracle_mean is not None]
    if means:
        panel.axhline(means[0], color=INK, linestyle=DASHES, linewidth=1, zorder=1)
    for method, style in styles.items():
        own = sorted((point for point in points if point.method_label == method), key=lambda point: point.depth)
        if not own:
            continue
        depths, returns = [point.depth for point in own], [point.mean for point in own]
        if any(point.std is not None for point in own):
            low, high = ([point.mean + sign * (point.std or 0.0) for point in own] for sign in (-1, 1))
            panel.fill_between(depths, low, high, color=style["color"], alpha=0.15, linewidth=0, zorder=2)
        panel.plot(depths, returns, linewidth=1.2, markeredgecolor="white", markeredgewidth=0.5, zorder=3, **style)
    panel.locator_params(axis="y", nbins=6)
    _dress(panel)


def _dress(panel: Axes) -> None:
    """Put grid, frame, ticks and margins as all panels have them."""
    panel.grid(True, color="#e6e6e6", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=SMALL, labelbottom=True, labelleft=True, color=GREY)
    panel.margins(x=0.06, y=0.12)


def _set_ticks(panel: Axes, rows: Sequence[FigurePoint]) -> None:
    """Put ticks at powers of two, few enough to be read; the panels share them."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    last = math.ceil(math.log2(max(row.leaves for row in rows)))
    step = math.ceil((last + 1) / MOST_TICKS)
    panel.xaxis.set_major_locator(FixedLocator([float(2**power) for power in range(0, last + 1, step)]))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    panel.xaxis.set_minor_locator(NullLocator())


def _legend(rows: Sequence[FigurePoint], styles: dict[str, dict[str, Any]]) -> list[Line2D]:
    """Return the legend's handles with their labels: the methods, and what hollow markers and dashed lines are."""
    from matplotlib.lines import Line2D

    labels = {row.method: row.method_label for row in rows}
    handles = [Line2D([], [], linestyle="none", label=labels[method], **style) for method, style in styles.items()]
    if any(row.published is not None for row in rows):
        hollow: dict[str, Any] = {"marker": "o", "markersize": 5.5 + HOLLOW_LARGER, "markerfacecolor": "none"}
        handles.append(Line2D([], [], linestyle="none", label="hollow: thesis", markeredgecolor=GREY, **hollow))
    if any(row.leaves == 1 for row in rows):
        handles.append(Line2D([], [], color=GREY, linestyle=DASHES, linewidth=1, label="score of one leaf"))
    return handles


def _depth_legend(points: Sequence[DepthPoint], styles: dict[str, dict[str, Any]], solved: float) -> list[Line2D]:
    """Return the legend's handles with their labels: the methods, the oracle and the line of solved."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], linewidth=1.2, label=method, **style) for method, style in styles.items()]
    if any(point.oracle_mean is not None for point in points):
        handles.append(Line2D([], [], color=INK, linestyle=DASHES, linewidth=1, label="oracle"))
    return [*handles, Line2D([], [], color=GREY, linestyle=DOTS, linewidth=1, label=f"solved ({solved:g})")]
