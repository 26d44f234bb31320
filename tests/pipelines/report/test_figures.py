"""The figure of scores, and the looks of methods and lines: what is drawn where."""

import numpy as np
import pandas as pd
import pytest

from pipelines.report.figures.style import OF_METHODS, auc_of_methods, line_styles, styles_of


def points(*rows):
    """Points from panel, label, leaves and mean, then standard deviation and published number where there are."""
    padded = [(*row, *[float("nan")] * (6 - len(row))) for row in rows]
    return pd.DataFrame(padded, columns=["panel", "label", "leaves", "mean", "std", "published"])


ROWS = points(
    ("Bace", "Linear", 1, 0.80),
    ("Bace", "OTR", 1200.5, 0.85, 0.01, 0.84),
    ("HIV", "Linear", 1, 0.71),
    ("HIV", "CART", 12, 0.62),
    ("HIV", "OTR", 30, 0.74, 0.02),
)


def marks(panel, marker, *, hollow=False):
    """Return where a panel has dots, filled or hollow, or a vertical line where the marker is "None"."""
    found = [line for line in panel.lines if line.get_marker() == marker]
    is_hollow = [line.get_markerfacecolor() == "none" for line in found]
    return [(line.get_xdata()[0], line.get_ydata()[0]) for line, is_so in zip(found, is_hollow, strict=True)
            if is_so == hollow]  # fmt: skip


def test_points_are_where_the_rows_say():
    bace, hiv = auc_of_methods(ROWS).axes
    assert [panel.get_title(loc="left") for panel in (bace, hiv)] == ["Bace", "HIV"]
    assert [text.get_text() for text in bace.get_yticklabels()] == ["Linear", "OTR", "CART"]  # no colour has to say it
    assert marks(bace, "o") == [(0.80, 0), (0.85, 1)] and marks(hiv, "o") == [(0.71, 0), (0.62, 2), (0.74, 1)]
    assert marks(bace, "o", hollow=True) == [(0.84, 1)] and marks(hiv, "o", hollow=True) == []
    assert [marks(panel, "None") for panel in (bace, hiv)] == [[(0.80, 0)], [(0.71, 0)]]  # the score of one leaf
    assert [text.get_text() for text in bace.texts] == ["1", "1,200"]  # leaves
    one, several = (container.lines[2] for container in bace.containers)
    assert one == ()  # a single run has no bar; others a deviation to either side
    np.testing.assert_allclose(several[0].get_segments()[0], [[0.84, 1], [0.86, 1]])


def test_the_legend_has_what_is_drawn_and_rows_without_leaves_are_refused():
    for rows, names in ((ROWS, ["ours", "thesis", "score of one leaf"]), (points(("Other", "CART", 2, 0.5)), ["ours"])):
        (legend,) = auc_of_methods(rows).legends
        assert [text.get_text() for text in legend.get_texts()] == names
    for rows, message in (([], "no points"), ([0.5], "at least 1 leaf"), ([float("nan")], "at least 1 leaf")):
        with pytest.raises(ValueError, match=message):
            auc_of_methods(points(*(("Bace", "OTR", leaves, 0.8) for leaves in rows)))


def test_lines_differ_by_more_than_their_colours():
    styles = [(style["color"], str(style["linestyle"])) for style in line_styles(map(str, range(42))).values()]
    assert len({*styles}) == 42 and len({dash for _, dash in styles[:6]}) == 6


@pytest.mark.parametrize("others", [[], ["CART"], ["OTR (tuned)", "NDPS"]])
def test_a_method_looks_the_same_in_every_figure(others):
    styles = styles_of(["OTR", *others, "VIPER (of OTR)"])
    assert styles["OTR"] == OF_METHODS["OTR"] and styles["VIPER (of OTR)"] == OF_METHODS["VIPER"]
    assert len({(style["color"], style["marker"]) for style in styles.values()}) == len(others) + 2


@pytest.mark.parametrize("n", [1, 4, 5])
def test_a_panel_for_every_data_set(n):
    figure = auc_of_methods(points(*((f"data{i}", "CART", 2 + i, 0.5) for i in range(n))))
    assert sum(panel.get_visible() for panel in figure.axes) == n
    labelled = [panel.get_title(loc="left") for panel in figure.axes if panel.get_xlabel()]
    n_columns = {4: 2, 5: 3}.get(n, n)
    assert labelled == [f"data{i}" for i in range(n - n_columns, n)]
