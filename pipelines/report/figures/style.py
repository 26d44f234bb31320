"""What figures share: colours, axes, labels; `otr.save_picture` writes them. matplotlib is loaded when one is drawn."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from pipelines.engine.store import read_summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

OF_LINES = 3.0  # letters that a line in a legend is long, so that its dashes are seen
PANEL_WIDTH, PANEL_HEIGHT, LEGEND_ROW = 3.4, 2.35, 0.2  # inches
SMALL, NORMAL = 8, 9  # points
MOST_TICKS = 6
# Okabe & Ito's colours without yellow, which colour-blind people distinguish; with 8 markers there are 56 pairs.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#444444")
MARKERS = (("o", 5.5), ("s", 5.0), ("^", 6.0), ("D", 5.0), ("v", 6.0), ("<", 6.0), (">", 6.0), ("p", 6.5))  # and sizes
GREY, INK = "#666666", "#1a1a1a"
# A method has its colour and its marker in every figure.
OF_METHODS = {
    label: {"color": colour, "marker": marker, "markersize": size}
    for label, colour, (marker, size) in zip(
        ("OTR", "OTR, distilled", "Experts", "π-PRL", "NDPS", "LM-VIPER", "VIPER", "Linear"),
        (*COLOURS, INK), MARKERS, strict=True,
    )
}  # fmt: skip
OF_METHODS["AugTree"] = OF_METHODS["Experts"]  # no figure has both
DASHES, DOTS, HOLLOW_LARGER = (0, (5, 3)), (0, (1, 2)), 3  # points

# Of lines, so that more than their colours distinguish them; 6 and 7 have no common divisor: there are 42 pairs.
LINES: tuple[Any, ...] = ("-", (0, (4, 1.2)), (0, (1, 1)), (0, (4, 1, 1, 1)), (0, (2, 1)), (0, (4, 1, 1, 1, 1, 1)))

Styles = dict[str, dict[str, Any]]


def return_against_depth(points: pd.DataFrame, solved: float, title: str | None = None) -> Figure:
    """Return a figure of the return against a tree's depth, a panel for each oracle.

    Bands, and bars where a method has one depth, are one standard deviation to either side; a dashed line is the
    oracle's own return, a dotted one the return from which the problem counts as solved. Panels, and
    methods in the legend, come in the order of the points.

    Args:
        points: at least one; columns `panel` (its title), `label` (the method in words), `depth` (of the tree), `mean`
            and `std` (of the return over runs; NaN of a single run) and `oracle_mean` (of the oracle's return).
        solved: the return from which the problem counts as solved.
        title: of the figure.
    """
    if points.empty:
        raise ValueError("no points were given")
    styles = styles_of(points["label"])
    handles = [legend_line(label, linewidth=1.2, **style) for label, style in styles.items()]
    if points["oracle_mean"].notna().any():
        handles.append(legend_line("oracle", color=INK, linestyle=DASHES, linewidth=1))
    handles.append(legend_line(f"solved ({solved:g})", color=GREY, linestyle=DOTS, linewidth=1))
    n_columns = min(points["panel"].nunique(), 2)
    figure, panels = figure_of_panels(
        points, n_columns, max(n_columns, 1.5), ("depth of the tree", "return"), share=(True, True)
    )
    for panel, (_, own) in zip(panels, points.groupby("panel", sort=False), strict=True):
        _draw_depths(panel, own, styles, solved)
    panels[0].set_xticks(sorted(set(points["depth"])))
    if title:
        figure.suptitle(title, fontsize=NORMAL)
    set_legend(figure, handles, 2 * n_columns)
    return figure


def auc_of_methods(points: pd.DataFrame) -> Figure:
    """Return a figure of the test AUC, a panel for each data set and a line for each method, which it names.

    Bars are one standard deviation to either side; hollow dots are the thesis's numbers; a dashed line is the score of
    a single leaf, which is the linear model. To the right are the leaves. Panels, and methods from the top, come in
    the order of the points.

    Args:
        points: at least one; columns `panel` (its title), `label` (the method in words), `leaves` (that rows reach, at
            least 1; a mean over runs need not be whole), `mean` and `std` (of the AUC over runs) and `published` (the
            thesis's AUC); what there is not is NaN.
    """
    wrong = points[~(points["leaves"] >= 1)]
    if points.empty or len(wrong):
        what = f"{wrong.iloc[0].to_dict()}" if len(wrong) else "no points were given"
        raise ValueError(f"{what}; expected points with at least 1 leaf")
    dot: dict[str, Any] = {"linestyle": "none", "marker": "o", "color": COLOURS[0]}
    hollow = dot | {"color": INK, "markersize": 5.5 + HOLLOW_LARGER, "markerfacecolor": "none"}
    handles = [legend_line("ours", **dot)]
    if points["published"].notna().any():
        handles.append(legend_line("thesis", **hollow))
    if (points["leaves"] == 1).any():
        handles.append(legend_line("score of one leaf", color=GREY, linestyle=DASHES, linewidth=1))
    labels = list(dict.fromkeys(points["label"]))
    n_panels = points["panel"].nunique()
    n_columns = n_panels if n_panels < 3 else 2 if n_panels == 4 else 3
    figure, panels = figure_of_panels(points, n_columns, n_columns, ("test AUC", ""), share=(False, True))
    for panel, (_, own) in zip(panels, points.groupby("panel", sort=False), strict=True):
        for point in own.itertuples():
            line = labels.index(point.label)
            if point.leaves == 1:
                panel.axvline(point.mean, color=GREY, linestyle=DASHES, linewidth=1, zorder=1)
            spread = None if math.isnan(point.std) else point.std
            panel.errorbar([point.mean], [line], xerr=spread, capsize=2.5, elinewidth=1, zorder=3, **dot)
            if not math.isnan(point.published):  # larger, so that it shows around the other where the two agree
                panel.plot([point.published], [line], zorder=4, **hollow)
            panel.text(1.02, line, f"{point.leaves:,.0f}", transform=panel.get_yaxis_transform(), va="center",
                       fontsize=SMALL - 1, color=GREY)  # fmt: skip
        panel.set_title("leaves", fontsize=SMALL - 1, color=GREY, loc="right")
        panel.locator_params(axis="x", nbins=5)
    panels[0].set_yticks(range(len(labels)), labels)
    panels[0].set_ylim(len(labels) - 0.4, -0.6)
    for i, panel in enumerate(panels):
        panel.tick_params(labelleft=i % n_columns == 0)
    set_legend(figure, handles, 3)
    return figure


def figure_of_panels(
    points: pd.DataFrame,
    n_columns: int,
    width: float,
    labels: tuple[str, str],
    n_legend_rows: int = 1,
    share: tuple[bool, bool] = (True, False),
) -> tuple[Figure, list[Axes]]:
    """Return a figure and its panels, `width` panels wide, with titles and with labels below and to the left."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(points["panel"]))
    n_rows = math.ceil(len(names) / n_columns)
    height = PANEL_HEIGHT * n_rows + LEGEND_ROW * (n_legend_rows + 1)
    figure = Figure(figsize=(PANEL_WIDTH * width, height), layout="constrained", facecolor="white")
    panels = list(figure.subplots(n_rows, n_columns, squeeze=False, sharex=share[0], sharey=share[1]).flat)
    for panel, name in zip(panels, names, strict=False):
        panel.set_title(name, fontsize=NORMAL, fontweight="bold", loc="left")
        panel.grid(True, color="#e6e6e6", linewidth=0.6)
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(labelsize=SMALL, labelbottom=True, labelleft=True, color=GREY)
        panel.margins(x=0.06, y=0.12)
    for panel in panels[len(names) :]:
        panel.set_visible(False)
    for panel in panels[max(len(names) - n_columns, 0) : len(names)]:
        panel.set_xlabel(labels[0], fontsize=SMALL)
    for panel in panels[::n_columns]:
        panel.set_ylabel(labels[1], fontsize=SMALL)
    return figure, panels[: len(names)]


def styles_of(labels: Iterable[str]) -> Styles:
    """Return colour and marker of every label, in the order in which they first come.

    A method, and the only label that adds something to its name in brackets, has the method's. Others have what no
    method among the labels has.
    """
    plain = {label: label.split(" (")[0] for label in labels}
    single = {label for label, name in plain.items() if name == label or list(plain.values()).count(name) == 1}
    known = {label: OF_METHODS[name] for label, name in plain.items() if label in single and name in OF_METHODS}
    colours, markers = ([style[key] for style in known.values()] for key in ("color", "marker"))
    free = cycle([colour for colour in COLOURS if colour not in colours] or COLOURS)
    shapes = cycle([marker for marker in MARKERS if marker[0] not in markers] or MARKERS)
    styles = {}
    for label in plain:
        if label not in known:
            marker, size = next(shapes)
            known[label] = {"color": next(free), "marker": marker, "markersize": size}
        styles[label] = known[label]
    return styles


def line_styles(labels: Iterable[str]) -> Styles:
    """Return colour and dashes of every label, in the order in which they first come."""
    return {
        label: {"color": COLOURS[i % len(COLOURS)], "linestyle": LINES[i % len(LINES)]}
        for i, label in enumerate(dict.fromkeys(labels))
    }


def _draw_depths(panel: Axes, points: pd.DataFrame, styles: Styles, solved: float) -> None:
    panel.axhline(solved, color=GREY, linestyle=DOTS, linewidth=1, zorder=1)
    for mean in points["oracle_mean"].dropna().iloc[:1]:
        panel.axhline(mean, color=INK, linestyle=DASHES, linewidth=1, zorder=1)
    for label, style in styles.items():
        own = points[points["label"] == label].sort_values("depth", kind="stable")
        line = {"linewidth": 1.2, "markeredgecolor": "white", "markeredgewidth": 0.5, **style}
        if own["std"].notna().any():
            low, high = own["mean"] - own["std"].fillna(0), own["mean"] + own["std"].fillna(0)
            if len(own) > 1:
                panel.fill_between(own["depth"], low, high, color=style["color"], alpha=0.15, linewidth=0, zorder=2)
            else:
                panel.vlines(own["depth"], low, high, color=style["color"], linewidth=1, zorder=2)
        if len(own):
            panel.plot(own["depth"], own["mean"], zorder=3, **line)
    panel.locator_params(axis="y", nbins=6)


def set_leaf_ticks(panel: Axes, most_leaves: float) -> None:
    """Put ticks at powers of two, few enough to be read; the panels share them."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    last = math.ceil(math.log2(most_leaves))
    step = math.ceil((last + 1) / MOST_TICKS)
    panel.xaxis.set_major_locator(FixedLocator([float(2**power) for power in range(0, last + 1, step)]))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    panel.xaxis.set_minor_locator(NullLocator())


def panel_and_label(run_dir: Path, but: Collection[str] = ()) -> dict[str, str]:
    """Return where a run is shown in a figure of runs: its environment, and its method, depth and budget in words.

    Settings other than the budget's are in the label, `but` these, or its folder's digest where no summary names them.
    """
    env, method, depth, budget, seed = run_dir.parts[-5:]
    label = f"{method}, {depth.replace('-', ' ', 1)}, {budget}"
    _, _, digest = seed.partition("~")
    if digest:
        summary = read_summary(run_dir)
        changes = re.split(r", (?=[\w.]+=)", summary.get("changes", f"settings {digest}"))
        label = ", ".join([label, *(change for change in changes if change.partition("=")[0] not in but)])
    return {"panel": env, "label": label}


def legend_line(label: str, **style: Any) -> Line2D:
    """Return a line for a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **style)


def set_legend(figure: Figure, handles: list[Line2D], n_columns: int, handle_length: float = 2.0) -> None:
    """Put a legend below the panels."""
    figure.legend(
        handles=handles, loc="outside lower center", ncols=min(n_columns, len(handles)),
        frameon=False, fontsize=SMALL, handletextpad=0.4, columnspacing=1.4, handlelength=handle_length,
    )  # fmt: skip
