"""A tree as an SVG, by the standard library alone."""

from __future__ import annotations

import html
from collections.abc import Sequence

from numpy.typing import ArrayLike

from otr.core.tree import ObliqueTree
from otr.programs.picture.scene import Box, Branch, Scene, Words
from otr.programs.picture.tree_picture import tree_scene

FONTS = "'DejaVu Sans', Verdana, Geneva, Arial, Helvetica, sans-serif"


def to_svg(
    tree: ObliqueTree,
    *,
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    precision: int = 2,
    max_terms: int = 3,
    states: ArrayLike | None = None,
    max_depth: int | None = None,
    title: str | None = None,
) -> str:
    """Return the picture that `draw_tree` makes of a tree, with the same arguments, as the text of an SVG file.

    It needs no other package. Pointing at a box shows its whole formula. The same tree gives the same text.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> otr.to_svg(tree)[:4]
        '<svg'
    """
    return svg_text(
        tree_scene(
            tree,
            feature_names=feature_names,
            output_names=output_names,
            precision=precision,
            max_terms=max_terms,
            states=states,
            max_depth=max_depth,
            title=title,
        )
    )


def svg_text(scene: Scene) -> str:
    """Return a scene as SVG, on a white sheet, which also reads on a dark page."""
    width, height = _number(scene.width), _number(scene.height)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}pt" height="{height}pt" viewBox="0 0 {width} {height}" '
        f'role="img" font-family="{FONTS}">',
        f"<title>{html.escape(scene.title)}</title>",
        f'<rect width="{width}" height="{height}" rx="6" fill="#ffffff"/>',
        *map(_item, scene.items),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _item(item: Box | Branch | Words) -> str:
    if isinstance(item, Box):
        place = " ".join(
            f'{name}="{_number(value)}"'
            for name, value in (("x", item.x), ("y", item.y), ("width", item.width), ("height", item.height))
        )
        look = f' rx="{_number(item.radius)}"' if item.radius else ""
        look += f' fill="{item.fill}"' + (f' stroke="{item.line}"' if item.line != "none" else "")
        look += ' stroke-dasharray="3 2"' if item.dashed else ""
        hint = f"<title>{html.escape(item.hint)}</title>" if item.hint else ""
        return f"<rect {place}{look}>{hint}</rect>" if hint else f'<rect {place}{look} pointer-events="none"/>'
    if isinstance(item, Branch):
        x, y, to_x, to_y, middle = map(_number, (item.x, item.y, item.to_x, item.to_y, (item.x + item.to_x) / 2))
        return (
            f'<path d="M{x} {y}C{middle} {y} {middle} {to_y} {to_x} {to_y}" fill="none" stroke="{item.colour}" '
            f'stroke-width="{_number(item.width)}"/>'
        )
    look = f'font-size="{_number(item.size)}" fill="{item.colour}"'
    look += "" if item.align == "start" else f' text-anchor="{item.align}"'
    look += ' font-weight="bold"' if item.bold else ""
    place = f'x="{_number(item.x)}" y="{_number(item.y)}"'
    # No pointer events, so that what a box has to say is shown under its words, too.
    return f'<text {place} {look} pointer-events="none">{html.escape(item.text)}</text>'


def _number(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")
