import re
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Polygon

import otr
from otr.programs.picture.boxes import Style, number_text, rows_of_test
from otr.programs.picture.drawing import EDGE_OF_ALL, EDGE_OF_NONE
from tests.core.strategies import make_network
from tests.core.test_tree import random_tree, small_tree
from tests.programs.test_text import mountain_car


def words(figure: Figure) -> list[str]:
    """Every text of the picture, box by box."""
    return [text.get_text() for text in figure.axes[0].texts if text.get_text() not in ("", "yes", "no")]


def edges(figure: Figure) -> list[PathPatch]:
    return [patch for patch in figure.axes[0].patches if isinstance(patch, PathPatch)]


def test_the_mountain_car_of_the_thesis() -> None:
    figure = otr.draw_tree(mountain_car(), feature_names=["x", "v"], precision=4, title="Mountain car")
    assert words(figure) == [
        "Mountain car",
        *("114.3", "v", "−3.8", "x", "−2.2", "≤ 0"),
        "−6.1",
        *("5116", "v", "−169.8", "x", "−102.3"),
    ]


def test_only_the_largest_terms_are_shown() -> None:
    tree = otr.ObliqueTree([~0], [~1], [[0.5, -3.0, 2.0, 0.0, 1.0]], [0.0], np.zeros((2, 1, 5)), [[1.0], [2.0]])
    assert words(otr.draw_tree(tree, max_terms=2)) == ["−3", "x1", "+2", "x2", "+", "2 more", "≤ 0", "1", "2"]


@pytest.mark.parametrize(
    ("coefficients", "offset", "rows"),
    [
        ([2.0, 0.0], -1.0, [("", "a ≤ 0.5")]),
        ([-2.0, 0.0], -1.0, [("", "a ≥ −0.5")]),
        ([0.0, 1.0], 0.0, [("", "b ≤ 0")]),
        ([0.0, 0.0], 0.31, [("0.31", "≤ 0")]),
        ([0.0, 0.0], 0.0, [("0", "≤ 0")]),
        ([-1.0, 1.0], 3.0, [("−1", "a"), ("+1", "b"), ("+3", "≤ 0")]),
    ],
)
def test_tests(coefficients: list[float], offset: float, rows: list[tuple[str, str]]) -> None:
    assert rows_of_test(np.array(coefficients), offset, Style(["a", "b"], [], 2, 4)) == rows


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (114.3, "114"),
        (-0.5, "−0.5"),
        (0.0996, "0.1"),
        (12345.6, "12346"),
        (2e6, "2e+06"),
        (-1.26e-7, "−1.3e−07"),
    ],
)
def test_numbers(value: float, text: str) -> None:
    assert number_text(value, 2) == text


def test_leaves_with_labels() -> None:
    tree = otr.map_network(make_network(np.random.default_rng(0), (), n_outputs=2, head="argmax"))
    assert words(otr.draw_tree(tree))[-2:] == ["0", "1"]
    assert words(otr.draw_tree(tree, output_names=["coast", "fire"]))[-2:] == ["coast", "fire"]
    assert words(otr.draw_tree(small_tree(labels=[7, 0, 9]))) == ["x0 ≤ 0", "7", "x1 ≤ 1", "0", "9"]


def test_leaves_of_several_outputs_and_heads() -> None:
    M = np.zeros((3, 2, 2))
    M[0, 0] = [1.0, -2.0]
    tree = small_tree(M=M, c=np.arange(6.0).reshape(3, 2), head=otr.ClipBox([0.0, 1.0], [2.0, 3.0]))
    assert words(otr.draw_tree(tree, output_names=["left", "right"])) == [
        "formulas are clipped to [0, 2], [1, 3]",
        "x0 ≤ 0",
        *("left =", "−2", "x1", "+1", "x0", "right =", "1"),
        "x1 ≤ 1",
        *("left =", "2", "right =", "3", "left =", "2", "right =", "3"),
    ]
    for head, note in (
        (otr.TanhBox(-2, 2), "formulas go through tanh, scaled to [−2, 2]"),
        (otr.Sign(), "a formula answers 1 where it is above 0, else 0"),
        (otr.Identity(), "114"),
    ):
        assert words(otr.draw_tree(mountain_car(head)))[0] == note
    assert "−1" in words(otr.draw_tree(mountain_car(otr.ClipBox(-1, 1))))  # the constant leaf, −6.1 before the head


def test_a_tree_without_tests() -> None:
    figure = otr.draw_tree(otr.ObliqueTree([], [], np.zeros((0, 1)), [], [[[2.0]]], [[-1.0]]), counts=[1])
    assert words(figure) == ["2", "x0", "−1", "1 row"]
    assert not edges(figure)


def test_counts_are_shown_and_set_the_widths_of_edges() -> None:
    figure = otr.draw_tree(small_tree(), counts=[1500, 500, 0])
    assert [word for word in words(figure) if "row" in word] == ["1,500 rows", "500 rows", "0 rows"]
    widths = [edge.get_linewidth() for edge in edges(figure)]
    assert widths == [EDGE_OF_ALL * 0.75, EDGE_OF_ALL * 0.25, EDGE_OF_ALL * 0.25, EDGE_OF_NONE]
    assert {edge.get_linewidth() for edge in edges(otr.draw_tree(small_tree(), counts=[0, 0, 0]))} == {EDGE_OF_NONE}


def test_what_lies_below_max_depth_is_folded() -> None:
    tree = otr.map_network(make_network(np.random.default_rng(1), (5,)))
    counts = np.arange(32)
    figure = otr.draw_tree(tree, max_depth=1, counts=counts)
    triangles = [patch for patch in figure.axes[0].patches if type(patch) is Polygon]
    assert len(triangles) == 2
    assert words(figure)[-4:] == ["16 leaves", f"{counts[:16].sum()} rows", "16 leaves", f"{counts[16:].sum()} rows"]
    assert words(otr.draw_tree(tree, max_depth=0)) == ["32 leaves"]
    assert words(otr.draw_tree(tree, max_depth=5)) == words(otr.draw_tree(tree))


@pytest.mark.parametrize("seed", range(3))
def test_no_text_overlaps_another(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, 12, 3, 2, 11)
    names = ["a", "a long name of an input (bit7)", "$x_2$ c1ccccc1"]
    for max_depth in (None, 3):
        figure = otr.draw_tree(tree, feature_names=names, counts=rng.integers(0, 99, 12), max_depth=max_depth)
        renderer = FigureCanvasAgg(figure).get_renderer()
        boxes = [text.get_window_extent(renderer) for text in figure.axes[0].texts if text.get_text()]
        for one, other in combinations(boxes, 2):  # a pixel is 0.7 points
            assert (
                min(one.x1, other.x1) - max(one.x0, other.x0) < 1 or min(one.y1, other.y1) - max(one.y0, other.y0) < 3
            )
        width, height = figure.get_size_inches() * figure.dpi
        assert all(box.x0 >= 0 and box.x1 <= width and box.y0 >= 0 and box.y1 <= height for box in boxes)


def test_too_many_leaves_are_refused_with_the_way_out() -> None:
    tree = otr.map_network(make_network(np.random.default_rng(0), (8,)))
    with pytest.raises(
        ValueError, match="a tree of 256 leaves would be drawn with 256, and a page holds 64; give max_d"
    ):
        otr.draw_tree(tree)
    with pytest.raises(ValueError, match="drawn with 128, and a page holds 64; give max_depth=6 or less"):
        otr.draw_tree(tree, max_depth=7)
    assert len(words(otr.draw_tree(tree, max_depth=4))) > 16


def test_bad_arguments_are_refused() -> None:
    for arguments, message in (
        ({"feature_names": ["x"]}, "feature_names has 1 names, expected 2"),
        ({"precision": 0}, "precision is 0, expected at least 1"),
        ({"max_terms": 0}, "max_terms is 0, expected at least 1"),
        ({"max_depth": -1}, "max_depth is -1, expected at least 0"),
        ({"counts": [1, 2]}, r"counts has shape \(2,\), expected \(3,\)"),
        ({"counts": [1, 2, -1]}, "integers of at least 0"),
        ({"counts": [1.5, 2, 3]}, "integers of at least 0, got float64"),
    ):
        with pytest.raises(ValueError, match=message):
            otr.draw_tree(small_tree(), **arguments)  # type: ignore[arg-type]
    network = otr.ReluNetwork([[[1.0]], [[1.0]]], [[0.0], [0.0]])
    with pytest.raises(TypeError, match=r"PatternTree has to_tree\(\)"):
        otr.draw_tree(otr.PatternTree(network))  # type: ignore[arg-type]


def test_a_saved_picture_is_the_same_every_time(tmp_path: Path) -> None:
    for suffix, start in (("png", b"\x89PNG"), ("svg", b"<?xml")):
        paths = [tmp_path / f"{name}.{suffix}" for name in "ab"]
        for path in paths:
            otr.save_picture(otr.draw_tree(small_tree(), counts=[1, 2, 3]), path)
        first, second = (path.read_bytes() for path in paths)
        assert first == second and first.startswith(start)
        assert not re.search(rb"Matplotlib|<dc:date>", first)
    with pytest.raises(ValueError, match=r"ends in '\.jpg', expected \.png or \.svg"):
        otr.save_picture(otr.draw_tree(small_tree()), tmp_path / "a.jpg")


def test_no_state_of_pyplot_is_touched() -> None:
    code = (
        "import sys, otr; otr.draw_tree(otr.ObliqueTree([~0], [~1], [[1.0]], [0.0], [[[0.0]]] * 2, [[1.0], [2.0]]))\n"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
