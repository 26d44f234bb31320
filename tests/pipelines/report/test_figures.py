"""The figure of leaves and scores: what is drawn where."""

import numpy as np
import pandas as pd
import pytest

from pipelines.report.figures.style import OF_METHODS, auc_against_leaves, styles_of


def points(*rows):
    """Points from panel, label, leaves and mean, then standard deviation and published number where there are."""
    padded = [(*row, *[float("nan")] * (6 - len(row))) for row in rows]
    return pd.DataFrame(padded, columns=["panel", "label", "leaves", "mean", "std", "published"])


ROWS = points(
    ("Bace", "Linear", 1, 0.80),
    ("Bace", "OTR", 200.5, 0.85, 0.01, 0.84),
    ("HIV", "Linear", 1, 0.71),
    ("HIV", "OTR", 30, 0.74, 0.02),
    ("HIV", "OTR", 8, 0.72, 0.02),
    ("HIV", "CART", 12, 0.62),
)


def lines(panel, kind):
    """Lines as (x, y): dashed, solid between points, hollow or filled markers."""

    def kind_of(line):
        if line.get_marker() in ("None", "_", "|"):
            return "dashed" if line.get_linestyle() == "--" else "solid" if line.get_linestyle() == "-" else "cap"
        return "hollow" if line.get_markerfacecolor() == "none" else "filled"

    return [(list(line.get_xdata()), list(line.get_ydata())) for line in panel.lines if kind_of(line) == kind]


def test_points_are_where_the_rows_say():
    bace, hiv = auc_against_leaves(ROWS).axes
    assert [panel.get_title(loc="left") for panel in (bace, hiv)] == ["Bace", "HIV"]
    assert lines(bace, "filled") == [([1], [0.80]), ([200.5], [0.85])]
    assert lines(bace, "hollow") == [([200.5], [0.84])]
    assert lines(bace, "dashed") == [([0, 1], [0.80, 0.80])]
    assert lines(hiv, "dashed") == [([0, 1], [0.71, 0.71])]
    assert lines(hiv, "solid") == [([8, 30], [0.72, 0.74])]
    assert lines(hiv, "hollow") == [] == lines(bace, "solid")
    assert bace.get_xscale() == "log" and bace.get_xlim() == hiv.get_xlim()
    assert bace.get_xticks().tolist() == [1, 4, 16, 64, 256]
    one, several = (container.lines[2] for container in bace.containers)
    assert one == ()  # a single run has no bar; others a deviation to either side
    np.testing.assert_allclose(several[0].get_segments()[0], [[200.5, 0.84], [200.5, 0.86]])


def test_a_method_looks_the_same_everywhere_and_stands_once_in_the_legend():
    figure = auc_against_leaves(ROWS)
    (legend,) = figure.legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names == ["Linear", "OTR", "CART", "hollow: thesis, at our leaves", "score of one leaf"]
    bace, hiv = figure.axes
    markers = {(line.get_marker(), line.get_color()) for line in bace.lines if list(line.get_xdata()) == [200.5]}
    assert {(line.get_marker(), line.get_color()) for line in hiv.lines if list(line.get_xdata()) == [30]} <= markers
    styles = [(line.get_marker(), line.get_color()) for line in legend.legend_handles[:3]]
    assert len(set(styles)) == 3
    (legend,) = auc_against_leaves(points(("Other", "CART", 2, 0.5))).legends  # has only what is drawn
    assert [text.get_text() for text in legend.get_texts()] == ["CART"]
    for rows, message in (([], "no points"), ([0.5], "at least 1 leaf"), ([float("nan")], "at least 1 leaf")):
        with pytest.raises(ValueError, match=message):
            auc_against_leaves(points(*(("Bace", "OTR", leaves, 0.8) for leaves in rows)))


@pytest.mark.parametrize("others", [[], ["CART"], ["OTR (tuned)", "NDPS"]])
def test_a_method_looks_the_same_in_every_figure(others):
    styles = styles_of(["OTR", *others, "VIPER (of OTR)"])
    assert styles["OTR"] == OF_METHODS["OTR"] and styles["VIPER (of OTR)"] == OF_METHODS["VIPER"]
    assert len({(style["color"], style["marker"]) for style in styles.values()}) == len(others) + 2


@pytest.mark.parametrize("n", [1, 4, 5])
def test_a_panel_for_every_data_set(n):
    figure = auc_against_leaves(points(*((f"data{i}", "CART", 2 + i, 0.5) for i in range(n))))
    assert sum(panel.get_visible() for panel in figure.axes) == n
    labelled = [panel.get_title(loc="left") for panel in figure.axes if panel.get_xlabel()]
    n_columns = {4: 2, 5: 3}.get(n, n)
    assert labelled == [f"data{i}" for i in range(n - n_columns, n)]
