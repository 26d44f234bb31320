"""A tree as a matplotlib figure, and figures as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from otr.core.tree import ObliqueTree
from otr.extras import naming_the_extra
from otr.programs.picture.scene import Box, Branch, Words
from otr.programs.picture.tree_picture import tree_scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FONT = "DejaVu Sans"  # comes with matplotlib, so a picture is the same everywhere
FORMATS = (".png", ".svg", ".pdf")


@naming_the_extra("otr.draw_tree")
def draw_tree(
    tree: ObliqueTree,
    *,
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    precision: int = 2,
    max_terms: int = 3,
    states: ArrayLike | None = None,
    max_depth: int | None = None,
    title: str | None = None,
) -> Figure:
    """Return a picture of `tree` as a matplotlib figure: the root on the left, a test's upper branch where it holds.

    A test shows its largest terms; one that reads a single input is solved for it, ``name ≤ 0.5``. A leaf shows its
    label, else its answer where that is constant, else the largest terms of its formulas or, of more than two outputs,
    what the strongest of them are on average over the states. Leaves are coloured by what they do: a hue for each
    label; answers from blue (low) to orange (high), the paler the nearer the middle. Tests whose two sides answer the
    same are left out (`otr.programs.merging`). More than 30 leaves are drawn as an icicle; of more than 400 what is
    deepest is folded up. The figure is as large as its text asks for. `otr.to_svg` returns the same as SVG, without
    matplotlib.

    Args:
        tree: any tree.
        feature_names, output_names: as in `to_text`.
        precision: significant digits, at least 1.
        max_terms: terms shown of a test or of a leaf's output, those with the largest coefficients, at least 1.
        states: (n, d) states or rows of data: every leaf shows the share of them that ends in it, branches are as
            wide as that, answers are averaged over them, and terms are compared in units of their inputs' spread.
        max_depth: subtrees below this many tests are folded up into boxes that name their leaves' number.
        title: a line above the tree.

    Raises:
        TypeError: `tree` is no ObliqueTree.
        ValueError: the wrong number of names, names that are not distinct, states of another width, or precision,
            max_terms, max_depth too low.
        MissingExtraError: matplotlib is not installed.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> type(otr.draw_tree(tree, feature_names=["angle"])).__name__
        'Figure'
    """
    from matplotlib.figure import Figure

    scene = tree_scene(
        tree,
        feature_names=feature_names,
        output_names=output_names,
        precision=precision,
        max_terms=max_terms,
        states=states,
        max_depth=max_depth,
        title=title,
    )
    figure = Figure(figsize=(scene.width / 72, scene.height / 72), facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set_xlim(0, scene.width)
    axes.set_ylim(scene.height, 0)
    for item in scene.items:
        _draw(axes, item)
    return figure


@naming_the_extra("otr.save_picture")
def save_picture(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, SVG or PDF, as the name ends; the same figure gives the same bytes, without a date.

    Raises:
        ValueError: the name has another ending, or there is no such folder.
        MissingExtraError: matplotlib is not installed.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> otr.save_picture(otr.draw_tree(tree), "tree.png")
    """
    import matplotlib

    folder = Path(path).parent
    if not folder.is_dir():
        raise ValueError(f"there is no folder {folder} to save {Path(path).name} in; make it first")
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise ValueError(f"the picture's name {str(path)!r} ends in {suffix!r}, expected {', '.join(FORMATS)}")
    metadata = {".png": {"Software": None}, ".svg": {"Date": None, "Creator": None},
                ".pdf": {"CreationDate": None, "Creator": None, "Producer": None}}[suffix]  # fmt: skip
    # matplotlib names the ids in an SVG by a random salt, unless it is given one.
    with matplotlib.rc_context({"svg.hashsalt": "otr", "svg.fonttype": "path"}):
        figure.savefig(path, format=suffix[1:], dpi=200, metadata=metadata)


def _draw(axes: Axes, item: Box | Branch | Words) -> None:
    """Draw one item of a scene; a dollar sign in a name starts no formula."""
    from matplotlib.patches import FancyBboxPatch, PathPatch
    from matplotlib.path import Path as Curve

    if isinstance(item, Words):
        align = {"start": "left", "middle": "center", "end": "right"}[item.align]
        text = axes.text(
            item.x, item.y, item.text, fontsize=item.size, fontfamily=FONT, color=item.colour, va="baseline"
        )
        text.set(ha=align, parse_math=False, fontweight="bold" if item.bold else "normal")
    elif isinstance(item, Branch):
        middle = (item.x + item.to_x) / 2
        points = [(item.x, item.y), (middle, item.y), (middle, item.to_y), (item.to_x, item.to_y)]
        curve = Curve(points, [Curve.MOVETO, Curve.CURVE4, Curve.CURVE4, Curve.CURVE4])
        patch = PathPatch(curve, facecolor="none", edgecolor=item.colour, linewidth=item.width)
        patch.set(capstyle="butt", zorder=1)
        axes.add_patch(patch)
    else:
        style = f"round,pad=0,rounding_size={item.radius}" if item.radius else "square,pad=0"
        box = FancyBboxPatch((item.x, item.y), item.width, item.height, boxstyle=style, zorder=2, facecolor=item.fill)
        box.set(edgecolor=item.line, linewidth=1 if item.line != "none" else 0, linestyle="--" if item.dashed else "-")
        axes.add_patch(box)
