import subprocess
import sys
import xml.etree.ElementTree as ET
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

import otr
from otr.programs.picture import colours
from otr.programs.picture.branches import THINNEST, WIDEST
from otr.programs.picture.drawing import FONT
from otr.programs.picture.formulas import Style, number_text, rows_of_test
from otr.programs.picture.scene import Box, Branch, Scene, text_width
from otr.programs.picture.tree_picture import MOST_BRANCHES, MOST_SHOWN, tree_scene
from tests.core.strategies import make_network
from tests.core.test_tree import random_tree, small_tree
from tests.programs.test_text import mountain_car

SVG = "{http://www.w3.org/2000/svg}"
FOUR_STATES = [[-1.0, 0.0], [-2.0, 5.0], [1.0, 0.0], [1.0, 3.0]]  # in leaves 0, 0, 1 and 2 of small_tree


def words(svg: str) -> list[str]:
    """Every text of the picture, but for those at branches."""
    shown = [text.text or "" for text in ET.fromstring(svg).iter(f"{SVG}text")]
    return [text for text in shown if text not in ("yes", "no")]


def scene(tree: otr.ObliqueTree, **arguments: object) -> Scene:
    usual = {"feature_names": None, "output_names": None, "precision": 2, "max_terms": 3, "states": None}
    return tree_scene(tree, **(usual | {"max_depth": None, "title": None} | arguments))  # type: ignore[arg-type]


def branches(drawn: Scene) -> list[Branch]:
    return [item for item in drawn.items if isinstance(item, Branch)]


def fills(drawn: Scene) -> list[str]:
    return [item.fill for item in drawn.items if isinstance(item, Box)]


def test_the_mountain_car_of_the_thesis() -> None:
    svg = otr.to_svg(mountain_car(), feature_names=["x", "v"], precision=4, title="Mountain car")
    assert words(svg) == [
        "Mountain car",
        *("114.3", "v", "−3.8", "x", "≤ 2.2"),
        "−6.1",
        *("5116", "v", "−169.8", "x", "−102.3"),
        "colours: the answer from low (blue) to high (orange)",
    ]  # fmt: skip
    assert ET.fromstring(svg).findtext(f"{SVG}title") == "Mountain car"


def test_only_the_largest_terms_are_shown_and_all_of_them_are_a_hint() -> None:
    tree = otr.ObliqueTree([~0], [~1], [[0.5, -3.0, 2.0, 0.0, 1.0]], [0.25], np.zeros((2, 1, 5)), [[1.0], [2.0]])
    svg = otr.to_svg(tree, max_terms=2)
    assert words(svg)[:6] == ["−3", "x1", "+2", "x2", "+ …", "≤ −0.25"]
    assert "<title>−3 x1 + 2 x2 + 1 x4 + 0.5 x0 ≤ −0.25</title>" in svg
    # In units of their spread over the states, of which x1 has none, x0 is the larger one.
    states = np.zeros((2, 5))
    states[1, [0, 2, 4]] = [100.0, 1.0, 1.0]
    assert words(otr.to_svg(tree, max_terms=2, states=states))[:4] == ["0.5", "x0", "+2", "x2"]


@pytest.mark.parametrize(
    ("coefficients", "offset", "rows"),
    [
        ([2.0, 0.0], -1.0, [("", "a ≤ 0.5")]),
        ([-2.0, 0.0], -1.0, [("", "a ≥ −0.5")]),
        ([0.0, 1.0], 0.0, [("", "b ≤ 0")]),
        ([0.0, 0.0], 0.31, [("", "0.31 ≤ 0")]),
        ([-1.0, 1.0], 3.0, [("−1", "a"), ("+1", "b"), ("", "≤ −3")]),
        ([-1.0, 1.0], 0.0, [("−1", "a"), ("+1", "b"), ("", "≤ 0")]),
    ],
)
def test_tests(coefficients: list[float], offset: float, rows: list[tuple[str, str]]) -> None:
    assert rows_of_test(np.array(coefficients), offset, Style(["a", "b"], [], 2, 4)) == rows


def test_numbers() -> None:
    values = (0.0, 114.3, -0.5, 0.0996, 12345.6, 2e6, -1.26e-7)
    assert [number_text(value, 2) for value in values] == [
        "0", "114", "−0.5", "0.1", "12346", "2e+06", "−1.3e−07",
    ]  # fmt: skip


def test_leaves_with_labels_have_a_name_and_a_colour_each() -> None:
    tree = otr.map_network(make_network(np.random.default_rng(0), (), n_outputs=2, head="argmax"))
    assert words(otr.to_svg(tree))[-2:] == ["0", "1"]
    assert words(otr.to_svg(tree, output_names=["coast", "fire"]))[-2:] == ["coast", "fire"]
    labelled = small_tree(labels=[7, 0, 1])
    assert words(otr.to_svg(labelled)) == ["x0 ≤ 0", "7", "x1 ≤ 1", "0", "1"]
    white, seven, other_white, zero, one = fills(scene(labelled))
    assert white == other_white == colours.TEST_FILL and len({white, seven, zero, one}) == 4


def test_the_colour_of_an_answer_is_its_place_in_the_range() -> None:
    tree = small_tree(c=[[-4.0], [0.0], [1.0]], head=otr.ClipBox(-2.0, 2.0))
    _, low, _, middle, high = fills(scene(tree))
    assert low == colours.level_colour(-1.0) == "#2e7bbd"  # the answer is clipped
    assert middle == colours.level_colour(0.0) == "#f6f6f4"
    assert high == colours.level_colour(0.5)
    assert colours.ink_on(low) == "#ffffff" and colours.ink_on(middle) == "#1a1a1a"


def test_leaves_of_several_outputs_and_heads() -> None:
    M = np.zeros((3, 2, 2))
    M[0, 0] = [1.0, -2.0]
    tree = small_tree(M=M, c=np.arange(6.0).reshape(3, 2), head=otr.ClipBox([0.0, 1.0], [2.0, 3.0]))
    assert words(otr.to_svg(tree, output_names=["left", "right"])) == [
        "x0 ≤ 0",
        *("left =", "−2", "x1", "+1", "x0", "right =", "1"),
        "x1 ≤ 1",
        *("2", "left", "3", "right"),
        *("2", "left", "3", "right"),
        "formulas are clipped to [0, 2], [1, 3]",
        "colours: the answers (left, right) from low (blue) to high (orange)",
    ]
    for head, note in (
        (otr.TanhBox(-2, 2), "formulas go through tanh, scaled to [−2, 2]"),
        (otr.Sign(), "a formula answers 1 where it is above 0, else 0"),
    ):
        assert note in words(otr.to_svg(mountain_car(head)))
    assert "−1" in words(otr.to_svg(mountain_car(otr.ClipBox(-1, 1))))  # the constant leaf, −6.1 before the head


def test_many_outputs_are_told_by_their_means_over_the_states() -> None:
    M = np.zeros((3, 5, 2))
    M[:, :, 0] = [1.0, 0.1, -0.5, 0.2, 0.3]
    tree = small_tree(M=M, c=np.zeros((3, 5)), head=otr.ClipBox([-1.0] * 5, [1.0] * 5))
    names = ["a", "b", "c", "d", "e"]
    alone = words(otr.to_svg(tree.replace(c=np.arange(15.0).reshape(3, 5)), output_names=names))
    assert alone[:10] == ["x0 ≤ 0", "a =", "1 x0", "b =", "0.1 x0 + …", "c =", "−0.5 x0 + …", "d =", "0.2 x0 + …", "+"]
    moved = tree.replace(c=np.zeros((3, 5)) + np.arange(3)[:, None] * 0.01)
    told = words(otr.to_svg(moved, output_names=names, states=[[-1.0, 0.0], [-0.5, 0.0], [1.0, 0.0]]))
    # The four strongest of the five, in their order: the first state's answers are -1, -.1, .5, ...
    assert told[1:10] == ["−0.75", "a", "0.38", "c", "−0.15", "d", "−0.22", "e", "+"]


def test_a_tree_without_tests() -> None:
    tree = otr.ObliqueTree([], [], np.zeros((0, 1)), [], [[[2.0]]], [[-1.0]])
    assert words(otr.to_svg(tree, states=[[3.0]]))[:5] == ["mean 5", "2", "x0", "−1", "100 %"]
    assert not branches(scene(tree))


def test_states_give_shares_and_the_widths_of_branches() -> None:
    svg = otr.to_svg(small_tree(), states=FOUR_STATES)
    assert [word for word in words(svg) if "%" in word] == ["50 %", "25 %", "25 %"]
    assert "per cent: of 4 states" in words(svg)
    widths = [branch.width for branch in branches(scene(small_tree(), states=FOUR_STATES))]
    assert widths == [WIDEST / 2, WIDEST / 2, WIDEST / 4, WIDEST / 4]
    never = scene(small_tree(), states=FOUR_STATES[:2])
    assert [branch.width for branch in branches(never)] == [WIDEST, THINNEST, THINNEST, THINNEST]
    assert words(otr.to_svg(small_tree(), states=FOUR_STATES[:2])).count("never") == 2


def test_equal_leaves_are_drawn_as_one() -> None:
    assert words(otr.to_svg(small_tree(labels=[1, 0, 0]), states=FOUR_STATES)) == [
        "x0 ≤ 0", "1", "50 %", "0", "50 %", "per cent: of 4 states",
    ]  # fmt: skip


def test_what_lies_below_max_depth_is_folded() -> None:
    tree = otr.map_network(make_network(np.random.default_rng(1), (5,)))
    drawn = scene(tree, max_depth=1)
    assert [item.hint for item in drawn.items if isinstance(item, Box) and item.dashed] == ["16 leaves", "16 leaves"]
    assert words(otr.to_svg(tree, max_depth=0)) == ["32 leaves"]
    assert words(otr.to_svg(tree, max_depth=5)) == words(otr.to_svg(tree))


def test_many_leaves_are_an_icicle_as_high_as_their_shares() -> None:
    tree = otr.map_network(make_network(np.random.default_rng(1), (5,)))
    assert tree.n_leaves > MOST_BRANCHES
    states = np.random.default_rng(0).normal(size=(500, 3))
    drawn = scene(tree, states=states)
    assert not branches(drawn) and drawn.width < 1200
    counts = np.bincount(tree.apply(states), minlength=32)
    cells = [item for item in drawn.items if isinstance(item, Box) and item.hint]
    right = max(cell.x + cell.width for cell in cells)
    leaves = sorted((cell for cell in cells if cell.x + cell.width == right), key=lambda cell: cell.y)
    assert [cell.hint.rpartition(" · ")[2] for cell in leaves if "never" not in cell.hint] == [
        f"{count / 5:.{0 if count >= 50 else 1}f} %" for count in counts if count
    ]
    heights = np.array([cell.height for cell in leaves])
    visited = counts > 0
    assert np.corrcoef(heights[visited], counts[visited])[0, 1] > 0.999
    assert heights[~visited].max(initial=0) < heights[visited].min()


def test_a_tree_of_any_size_is_drawn() -> None:
    tree = otr.map_network(make_network(np.random.default_rng(0), (10,)))
    drawn = scene(tree)
    folded = [item for item in drawn.items if isinstance(item, Box) and item.hint.endswith("leaves")]
    assert len(folded) == 256 <= MOST_SHOWN < 512
    assert drawn.width < 1200 and drawn.height < 1300


@pytest.mark.parametrize(("seed", "n_leaves"), [(0, 12), (1, 12), (2, 45)])
def test_no_text_overlaps_another(seed: int, n_leaves: int) -> None:
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, n_leaves, 3, 2, 11)
    names = ["a", "a long name of an input (bit7)", "$x_2$ c1ccccc1"]
    for max_depth in (None, 3):
        figure = otr.draw_tree(tree, feature_names=names, states=rng.normal(size=(99, 3)), max_depth=max_depth)
        renderer = FigureCanvasAgg(figure).get_renderer()
        boxes = [text.get_window_extent(renderer) for text in figure.axes[0].texts if text.get_text()]
        for one, other in combinations(boxes, 2):  # a pixel is 0.7 points
            assert (
                min(one.x1, other.x1) - max(one.x0, other.x0) < 1 or min(one.y1, other.y1) - max(one.y0, other.y0) < 3
            )
        width, height = figure.get_size_inches() * figure.dpi
        assert all(box.x0 >= 0 and box.x1 <= width and box.y0 >= 0 and box.y1 <= height for box in boxes)


@pytest.mark.parametrize("bold", [False, True])
def test_text_is_as_wide_as_in_the_font(bold: bool) -> None:
    font = FontProperties(family=FONT, size=10, weight="bold" if bold else "normal")
    for text in ("−0.44 foot_angle ≤ 1.9", "Lunar Lander: WAVE · 12 %", "".join(map(chr, range(33, 127)))):
        width, _, _ = text_to_path.get_text_width_height_descent(text, font, ismath=False)
        assert text_width(text, 10, bold=bold) == pytest.approx(width, rel=0.03)
    assert text_width("漢字", 10, bold=bold) == 20


def test_bad_arguments_are_refused() -> None:
    for arguments, message in (
        ({"feature_names": ["x"]}, "feature_names has 1 names, expected 2"),
        ({"precision": 0}, "precision is 0, expected at least 1"),
        ({"max_terms": 0}, "max_terms is 0, expected at least 1"),
        ({"max_depth": -1}, "max_depth is -1, expected at least 0"),
        ({"states": [[1.0, 2.0, 3.0]]}, "3"),
    ):
        for draw in (otr.draw_tree, otr.to_svg):
            with pytest.raises(ValueError, match=message):
                draw(small_tree(), **arguments)  # type: ignore[operator]
    network = otr.ReluNetwork([[[1.0]], [[1.0]]], [[0.0], [0.0]])
    with pytest.raises(TypeError, match=r"PatternTree has to_tree\(\)"):
        otr.draw_tree(otr.PatternTree(network))  # type: ignore[arg-type]


def test_a_saved_picture_is_the_same_every_time(tmp_path: Path) -> None:
    for suffix, start in (("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")):
        paths = [tmp_path / f"{name}.{suffix}" for name in "ab"]
        for path in paths:
            otr.save_picture(otr.draw_tree(small_tree(), states=FOUR_STATES), path)
        first, second = (path.read_bytes() for path in paths)
        assert first == second and first.startswith(start)
        assert b"CreationDate" not in first and b"<dc:date>" not in first
    with pytest.raises(ValueError, match=r"ends in '\.jpg', expected \.png, \.svg, \.pdf"):
        otr.save_picture(otr.draw_tree(small_tree()), tmp_path / "a.jpg")
    with pytest.raises(ValueError, match=r"there is no folder .*missing to save a.png in"):
        otr.save_picture(otr.draw_tree(small_tree()), tmp_path / "missing" / "a.png")


def test_a_notebook_shows_the_picture() -> None:
    assert small_tree()._repr_svg_() == otr.to_svg(small_tree())


def test_an_svg_needs_no_other_package_and_no_state_of_pyplot_is_touched() -> None:
    code = (
        "import sys, otr; tree = otr.ObliqueTree([~0], [~1], [[1.0]], [0.0], [[[0.0]]] * 2, [[1.0], [2.0]])\n"
        "otr.to_svg(tree); assert 'matplotlib' not in sys.modules\n"
        "otr.draw_tree(tree); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
