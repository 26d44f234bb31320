"""The figure of leaves and scores: what is drawn where."""

import subprocess
import sys

import numpy as np
import pytest

import otr
from pipelines.report.figures import FigurePoint, auc_against_leaves

ROWS = [
    FigurePoint("bace", "linear", "Linear", 1, 0.80),
    FigurePoint("bace", "otr", "OTR", 200.5, 0.85, 0.01, published=0.84),
    FigurePoint("hiv", "linear", "Linear", 1, 0.71),
    FigurePoint("hiv", "otr", "OTR", 30, 0.74, 0.02),
    FigurePoint("hiv", "otr", "OTR", 8, 0.72, 0.02),
    FigurePoint("hiv", "cart", "CART", 12, 0.62, None),
]


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


def test_bars_are_a_deviation_to_either_side():
    bace, _ = auc_against_leaves(ROWS).axes
    bars = [container.lines[2] for container in bace.containers]
    assert bars[0] == ()  # a single run
    (segment,) = bars[1][0].get_segments()
    np.testing.assert_allclose(segment, [[200.5, 0.84], [200.5, 0.86]])


def test_a_method_looks_the_same_everywhere_and_stands_once_in_the_legend():
    figure = auc_against_leaves(ROWS, title="Leaves")
    assert figure.get_suptitle() == "Leaves"
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "Linear",
        "OTR",
        "CART",
        "hollow: thesis",
        "score of one leaf",
    ]
    bace, hiv = figure.axes
    markers = {(line.get_marker(), line.get_color()) for line in bace.lines if list(line.get_xdata()) == [200.5]}
    assert {(line.get_marker(), line.get_color()) for line in hiv.lines if list(line.get_xdata()) == [30]} <= markers
    styles = [(line.get_marker(), line.get_color()) for line in legend.legend_handles[:3]]
    assert len(set(styles)) == 3


def test_the_legend_has_only_what_is_drawn():
    (legend,) = auc_against_leaves([FigurePoint("other", "cart", "CART", 2, 0.5)]).legends
    assert [text.get_text() for text in legend.get_texts()] == ["CART"]


@pytest.mark.parametrize("n, shown", [(1, 1), (2, 2), (3, 3), (4, 4), (5, 5)])
def test_a_panel_for_every_data_set(n, shown, tmp_path):
    rows = [FigurePoint(f"data{i}", "cart", "CART", 2 + i, 0.5) for i in range(n)]
    figure = auc_against_leaves(rows)
    assert sum(panel.get_visible() for panel in figure.axes) == shown
    labelled = [panel.get_title(loc="left") for panel in figure.axes if panel.get_xlabel()]
    n_columns = {4: 2, 5: 3}.get(n, n)
    assert labelled == [f"data{i}" for i in range(n - n_columns, n)]


def test_it_is_saved_the_same_every_time(tmp_path):
    for name in "ab":
        otr.save_picture(auc_against_leaves(ROWS), tmp_path / f"{name}.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()


def test_rows_that_cannot_be_drawn_are_refused():
    with pytest.raises(ValueError, match="no rows were given"):
        auc_against_leaves([])
    for leaves in (0.5, float("nan")):
        with pytest.raises(ValueError, match="at least 1 leaf"):
            auc_against_leaves([FigurePoint("bace", "otr", "OTR", leaves, 0.8)])


def test_pyplot_is_not_touched():
    code = (
        "import sys; from pipelines.report.figures import FigurePoint, auc_against_leaves\n"
        "assert 'matplotlib' not in sys.modules\n"
        "auc_against_leaves([FigurePoint('bace', 'otr', 'OTR', 4, 0.8)])\n"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
