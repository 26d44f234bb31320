"""A tree as a picture, to be read from the root at the top; needs matplotlib, which is loaded when one is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import IntArray
from otr.core.tree import ObliqueTree
from otr.extras import naming_the_extra
from otr.programs.names import one_line, shown_names
from otr.programs.picture.boxes import NodeBox, Style, head_note, tree_boxes
from otr.programs.picture.layout import tidy_layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

MAX_SHOWN_LEAVES = 64
FONT = "DejaVu Sans"  # comes with matplotlib, so a picture is the same everywhere
# All lengths are points, 1/72 inch.
TEXT, TITLE, HEADING, NOTE = 8.0, 9.5, 12.0, 7.0
LINE, COLUMN_GAP, PADDING, MARGIN = 1.3, 4.0, 6.0, 12.0
BOX_GAP, ROW_GAP, LEAST_WIDTH = 14.0, 44.0, 40.0
EDGE, EDGE_OF_ALL, EDGE_OF_NONE = 1.0, 10.0, 0.5
INK, FAINT, EDGE_INK = "#1a1a1a", "#666666", "#9aa5b1"
TEST_FILL, TEST_LINE, SUBTREE_FILL = "#ffffff", "#7b8794", "#eef1f4"
# Okabe & Ito's colours, which colour-blind people tell apart: line and a tint of it, one a label.
LABEL_COLOURS = (
    ("#0072b2", "#d6e9f5"), ("#d55e00", "#fbe3d2"), ("#009e73", "#d3efe6"), ("#cc79a7", "#f6e4ee"),
    ("#e69f00", "#fcefcf"), ("#56b4e9", "#e4f3fc"), ("#8a7f00", "#f6f2c4"), ("#444444", "#e4e4e4"),
)  # fmt: skip
VALUE_COLOURS = ("#8a7f00", "#fbf8e3")


@naming_the_extra("otr.draw_tree")
def draw_tree(
    tree: ObliqueTree,
    *,
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    precision: int = 2,
    max_terms: int = 4,
    counts: ArrayLike | None = None,
    max_depth: int | None = None,
    title: str | None = None,
) -> Figure:
    """Return a picture of `tree`: tests in round boxes, left where they hold (yes), leaves in colour.

    A test shows its largest terms; one that reads a single input is solved for it, ``name ≤ 0.5``. A leaf shows its
    label, else its answer where that is constant, else the largest terms of its formulas; what the head makes of these
    stands below the tree. The figure is as large as its text asks for.

    Args:
        tree: any tree of at most 64 leaves, or folded to so many by `max_depth`.
        feature_names, output_names: as in `to_text`.
        precision: significant digits, at least 1.
        max_terms: terms shown of a test or of a leaf's output, those with the largest coefficients; at least 1.
        counts: (n_leaves,) integers, rows of data that end in each leaf: shown there, and edges are as wide as the
            share of the rows that pass. ``np.bincount(tree.apply(X), minlength=tree.n_leaves)`` gives them.
        max_depth: subtrees below this many tests become triangles that name their leaves' number.
        title: a line above the tree.

    Raises:
        TypeError: `tree` is no ObliqueTree.
        ValueError: too many leaves, the wrong number of names or counts, or precision, max_terms, max_depth too low.
        MissingExtraError: matplotlib is not installed.
    """
    if not isinstance(tree, ObliqueTree):
        raise TypeError(f"tree is a {type(tree).__name__}, expected an ObliqueTree; a PatternTree has to_tree()")
    for name, value, least in (("precision", precision, 1), ("max_terms", max_terms, 1), ("max_depth", max_depth, 0)):
        if value is not None and value < least:
            raise ValueError(f"{name} is {value}, expected at least {least}")
    _check_size(tree, max_depth)
    features, answers = shown_names(tree, feature_names, output_names)
    rows = None if counts is None else _checked_counts(counts, tree.n_leaves)
    boxes = tree_boxes(tree, Style(features, answers, precision, max_terms), rows, max_depth)
    return _Picture(boxes, one_line(title or ""), head_note(tree)).figure()


@naming_the_extra("otr.save_picture")
def save_picture(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG or SVG, as the name ends; the same figure gives the same bytes, without a date.

    Raises:
        ValueError: the name ends otherwise.
        MissingExtraError: matplotlib is not installed.
    """
    import matplotlib

    suffix = Path(path).suffix.lower()
    if suffix not in (".png", ".svg"):
        raise ValueError(f"the picture's name {str(path)!r} ends in {suffix!r}, expected .png or .svg")
    # matplotlib names the ids in an SVG by a random salt, unless it is given one.
    with matplotlib.rc_context({"svg.hashsalt": "otr", "svg.fonttype": "path"}):
        metadata = {"Software": None} if suffix == ".png" else {"Date": None, "Creator": None}
        figure.savefig(path, format=suffix[1:], dpi=200, metadata=metadata)


def _check_size(tree: ObliqueTree, max_depth: int | None) -> None:
    shown = [1]  # at each max_depth; every test shown adds one
    for level in tree.levels:
        shown.append(shown[-1] + len(level))
    n_shown = shown[-1 if max_depth is None else min(max_depth, tree.depth)]
    if n_shown > MAX_SHOWN_LEAVES:
        depth = max(depth for depth, n in enumerate(shown) if n <= MAX_SHOWN_LEAVES)
        raise ValueError(
            f"a tree of {tree.n_leaves:,} leaves would be drawn with {n_shown:,}, and a page holds {MAX_SHOWN_LEAVES}; "
            f"give max_depth={depth} or less to fold what is below, or prune the tree first"
        )


def _checked_counts(counts: ArrayLike, n_leaves: int) -> IntArray:
    array = np.asarray(counts)
    if array.shape != (n_leaves,):
        raise ValueError(f"counts has shape {array.shape}, expected ({n_leaves},): a number a leaf")
    if array.dtype.kind not in "iu" or (array < 0).any():
        raise ValueError(f"counts must be integers of at least 0, got {array.dtype} from {array.min()} on")
    return array.astype(np.int64)


class _Picture:
    """Boxes measured and placed; `figure` draws them. x grows to the right and y downwards, from the tree's corner."""

    def __init__(self, boxes: list[NodeBox], title: str, note: str) -> None:
        self.boxes, self.title, self.note = boxes, title, note
        self.sizes = [self._size(box) for box in boxes]
        self.depths = [0] * len(boxes)
        for i, box in enumerate(boxes):
            for child in box.children:
                self.depths[child] = self.depths[i] + 1
        self.x = tidy_layout([box.children for box in boxes], [width for width, _ in self.sizes], BOX_GAP)
        levels = range(max(self.depths) + 1)
        self.heights = [
            max(h for (_, h), d in zip(self.sizes, self.depths, strict=True) if d == level) for level in levels
        ]
        self.tops = [sum(self.heights[:level]) + level * ROW_GAP for level in levels]

    def figure(self) -> Figure:
        from matplotlib.figure import Figure

        right = max(x + width / 2 for x, (width, _) in zip(self.x, self.sizes, strict=True))
        width = max(right, _text_width(self.title, HEADING, bold=True), _text_width(self.note, NOTE)) + 2 * MARGIN
        above = MARGIN + (HEADING * 2 if self.title else 0)
        below = MARGIN + (NOTE * 2.5 if self.note else 0)
        height = above + self.tops[-1] + self.heights[-1] + below
        figure = Figure(figsize=(width / 72, height / 72), facecolor="white")
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        start = (right - width) / 2  # the tree is centred where the title is wider
        axes.set_xlim(start, start + width)
        axes.set_ylim(height - above, -above)
        middle = right / 2
        if self.title:
            _write(axes, middle, MARGIN - above, self.title, HEADING, align="center", bold=True)
        if self.note:
            _write(axes, middle, height - above - MARGIN - NOTE * LINE, self.note, NOTE, align="center", colour=FAINT)
        self._draw_edges(axes)
        for i in range(len(self.boxes)):
            self._draw_box(axes, i)
        return figure

    def _size(self, box: NodeBox) -> tuple[float, float]:
        """Return a box's width and height."""
        left, right = _columns(box)
        headings = [_text_width(row, TEXT, bold=True) for row in box.rows if isinstance(row, str)]
        captions = [*headings, _text_width(box.title, TITLE, bold=True), _text_width(_count_text(box), NOTE)]
        width = max(left + right + (COLUMN_GAP if left and right else 0), *captions)
        height = LINE * (TITLE * bool(box.title) + TEXT * len(box.rows) + NOTE * bool(_count_text(box)))
        if box.kind != "subtree":
            return max(width + 2 * PADDING, LEAST_WIDTH), height + 2 * PADDING
        # The text stands at the bottom of a triangle, whose width where the text begins is half of that of its base.
        return 2 * width + 2 * PADDING, 2 * height + PADDING

    def _draw_box(self, axes: Axes, i: int) -> None:
        from matplotlib.patches import FancyBboxPatch, Polygon

        box, x, (width, height), top = self.boxes[i], self.x[i], self.sizes[i], self.tops[self.depths[i]]
        line, fill = colours(box)
        if box.kind == "subtree":
            corners = [(x, top), (x - width / 2, top + height), (x + width / 2, top + height)]
            axes.add_patch(Polygon(corners, facecolor=fill, edgecolor=line, linewidth=1, joinstyle="round", zorder=2))
            y = top + height / 2
        else:
            corner = 7 if box.kind == "test" else 1.5
            style = f"round,pad=0,rounding_size={corner}"
            patch = FancyBboxPatch((x - width / 2, top), width, height, boxstyle=style, zorder=2)
            patch.set(facecolor=fill, edgecolor=line, linewidth=1)
            axes.add_patch(patch)
            y = top + PADDING
        if box.title:
            _write(axes, x, y, box.title, TITLE, align="center", bold=True)
            y += TITLE * LINE
        left, right = _columns(box)
        gap = COLUMN_GAP if left and right else 0
        split = x - (left + gap + right) / 2 + left
        for row in box.rows:
            if isinstance(row, str):
                _write(axes, x - width / 2 + PADDING, y, row, TEXT, align="left", bold=True)
            else:
                _write(axes, split, y, row[0], TEXT, align="right")
                _write(axes, split + gap, y, row[1], TEXT, align="left")
            y += TEXT * LINE
        if _count_text(box):
            _write(axes, x, y, _count_text(box), NOTE, align="center", colour=FAINT)

    def _draw_edges(self, axes: Axes) -> None:
        """Draw the edges as curves between one row of boxes and the next, so that they pass no box and never cross."""
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path as Curve

        for i, box in enumerate(self.boxes):
            if not box.children:
                continue
            depth = self.depths[i]
            start, bend = self.tops[depth] + self.sizes[i][1], self.tops[depth] + self.heights[depth]
            end = bend + ROW_GAP
            widths = [self._edge_width(child) for child in box.children]
            # Side by side where they leave the box, so that the two together are as wide as what comes in above.
            leaves_at = (self.x[i] - widths[1] / 2, self.x[i] + widths[0] / 2)
            for child, x, width, word in zip(box.children, leaves_at, widths, ("yes", "no"), strict=True):
                middle = (bend + end) / 2
                to = self.x[child]
                inside = end + (width if self.boxes[child].kind == "subtree" else 0)  # behind the triangle's tip
                points = [(x, start), (x, bend), (x, middle), (to, middle), (to, end), (to, inside)]
                codes = [Curve.MOVETO, Curve.LINETO, Curve.CURVE4, Curve.CURVE4, Curve.CURVE4, Curve.LINETO]
                patch = PathPatch(Curve(points, codes), facecolor="none", edgecolor=EDGE_INK, linewidth=width)
                patch.set(capstyle="butt", zorder=1)
                axes.add_patch(patch)
                text = _write(axes, (x + to) / 2, middle - NOTE / 2, word, NOTE, align="center")
                text.set_bbox({"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none"})

    def _edge_width(self, child: int) -> float:
        n_all, n_rows = self.boxes[0].n_rows, self.boxes[child].n_rows
        if n_all is None or n_rows is None:
            return EDGE
        return max(EDGE_OF_ALL * n_rows / max(n_all, 1), EDGE_OF_NONE)


def _columns(box: NodeBox) -> tuple[float, float]:
    """Return the widths of the two columns of a box's rows."""
    rows = [row for row in box.rows if not isinstance(row, str)]
    left, right = (max((_text_width(row[column], TEXT) for row in rows), default=0.0) for column in (0, 1))
    return left, right


def colours(box: NodeBox) -> tuple[str, str]:
    """Return the colours of a box's outline and inside."""
    if box.kind != "leaf":
        return TEST_LINE, TEST_FILL if box.kind == "test" else SUBTREE_FILL
    return VALUE_COLOURS if box.label is None else LABEL_COLOURS[box.label % len(LABEL_COLOURS)]


def _count_text(box: NodeBox) -> str:
    return "" if box.n_rows is None or box.kind == "test" else f"{box.n_rows:,} row{'' if box.n_rows == 1 else 's'}"


def _text_width(text: str, size: float, *, bold: bool = False) -> float:
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(family=FONT, size=size, weight="bold" if bold else "normal")
    width, _, _ = text_to_path.get_text_width_height_descent(text, font, ismath=False)
    return float(width)


def _write(
    axes: Axes,
    x: float,
    top: float,
    text: str,
    size: float,
    *,
    align: Literal["left", "center", "right"],
    bold: bool = False,
    colour: str = INK,
) -> Text:
    """Write a line of text whose upper edge is at `top`; a dollar sign in a name starts no formula."""
    written = axes.text(x, top + size, text, fontsize=size, fontfamily=FONT, color=colour, ha=align, va="baseline")
    written.set(parse_math=False, fontweight="bold" if bold else "normal", zorder=3)
    return written
