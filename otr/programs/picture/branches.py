"""A tree of few leaves as boxes and branches: each test's upper branch is taken where it holds."""

from __future__ import annotations

from collections.abc import Sequence

from otr.programs.picture import colours
from otr.programs.picture.boxes import NodeBox, share_text
from otr.programs.picture.layout import tidy_layout
from otr.programs.picture.scene import FAINT, INK, Box, Branch, Scene, Words, text_width

TEXT, TITLE, HEADING, NOTE = 8.0, 9.5, 12.0, 7.0
LINE, COLUMN_GAP, PADDING, MARGIN = 1.3, 4.0, 5.0, 12.0
BOX_GAP, COLUMN, LEAST_WIDTH = 9.0, 46.0, 34.0
STRIPE = 9.0  # width of the colours of several answers
WIDEST, THINNEST, PLAIN = 16.0, 0.75, 1.5  # branches


def branches(boxes: Sequence[NodeBox], title: str, notes: Sequence[str]) -> Scene:
    """Return the scene of boxes, parents before children, with a title above and notes below."""
    sizes = [_size(box) for box in boxes]
    middles = tidy_layout([box.children for box in boxes], [height for _, height in sizes], BOX_GAP)
    depths = [0] * len(boxes)
    for i, box in enumerate(boxes):
        for child in box.children:
            depths[child] = depths[i] + 1
    widths = [
        max(width for (width, _), d in zip(sizes, depths, strict=True) if d == depth)
        for depth in range(max(depths) + 1)
    ]
    top = MARGIN + (HEADING * 1.8 if title else 0)
    lefts = [MARGIN + sum(widths[:depth]) + depth * COLUMN for depth in range(len(widths))]
    y = [top + middle for middle in middles]
    bottom = max(at + height / 2 for at, (_, height) in zip(y, sizes, strict=True))
    right = max(lefts[d] + width for d, (width, _) in zip(depths, sizes, strict=True))
    items: list[Box | Branch | Words] = (
        [Words(MARGIN, MARGIN + HEADING * 0.9, title, HEADING, bold=True)] if title else []
    )
    for i, box in enumerate(boxes):
        start = lefts[depths[i]] + sizes[i][0]
        shares = [_branch_width(boxes, child) for child in box.children]
        # Side by side where they leave the box, so that the two together are as wide as what comes in.
        offsets = (-shares[1] / 2, shares[0] / 2) if shares else ()
        for child, width, offset in zip(box.children, shares, offsets, strict=True):
            items.append(Branch(start, y[i] + offset, lefts[depths[child]], y[child], width, colours.BRANCH))
        for child, word, side in zip(box.children, ("yes", "no"), (-1, 1), strict=False):
            middle = y[child] + side * (max(_branch_width(boxes, child) / 2, 1) + NOTE * (0.25 if side < 0 else 0.95))
            items.append(Words(lefts[depths[child]] - 3, middle, word, NOTE, "end", colour=FAINT))
    for i, box in enumerate(boxes):
        items += _box(boxes, box, lefts[depths[i]], y[i], sizes[i])
    for note in notes:
        bottom += NOTE * 1.6
        items.append(Words(MARGIN, bottom + NOTE * 0.6, note, NOTE, colour=FAINT))
    text = max(text_width(title, HEADING, bold=True), *(text_width(note, NOTE) for note in ["", *notes]))
    return Scene(max(right, MARGIN + text) + MARGIN, bottom + MARGIN, title or "a decision tree", tuple(items))


def _branch_width(boxes: Sequence[NodeBox], child: int) -> float:
    n_all, n_rows = boxes[0].n_rows, boxes[child].n_rows
    return PLAIN if n_all is None or n_rows is None else max(WIDEST * n_rows / max(n_all, 1), THINNEST)


def _columns(box: NodeBox) -> tuple[float, float]:
    """Return the widths of the two columns of a box's rows."""
    rows = [row for row in box.rows if not isinstance(row, str)]
    left, right = (max((text_width(row[column], TEXT) for row in rows), default=0.0) for column in (0, 1))
    return left, right


def _size(box: NodeBox) -> tuple[float, float]:
    """Return a box's width and height; room for its share is left where there are states."""
    left, right = _columns(box)
    headings = [text_width(row, TEXT, bold=True) for row in box.rows if isinstance(row, str)]
    share = text_width("100 %", NOTE) if _shows_share(box) else 0.0
    width = max(
        left + right + (COLUMN_GAP if left and right else 0),
        text_width(box.title, TITLE, bold=True),
        share,
        *headings,
        0,
    )
    height = LINE * (TITLE * bool(box.title) + TEXT * len(box.rows) + NOTE * _shows_share(box))
    stripe = STRIPE if len(box.levels) > 1 else 0
    return max(width + 2 * PADDING, LEAST_WIDTH) + stripe, height + 1.4 * PADDING


def _shows_share(box: NodeBox) -> bool:
    return box.n_rows is not None and box.kind != "test"


def look(box: NodeBox) -> tuple[str, str, str]:
    """Return the colours of a box's outline, its inside and its words."""
    if box.kind != "leaf":
        return colours.TEST_LINE, colours.TEST_FILL if box.kind == "test" else colours.FOLDED_FILL, INK
    if box.label is not None:
        return *colours.label_colours(box.label), INK
    if len(box.levels) == 1:
        fill = colours.level_colour(box.levels[0])
        return colours.LEAF_LINE, fill, colours.ink_on(fill)
    return (colours.LEAF_LINE, "#ffffff", INK) if box.levels else (colours.UNKNOWN_LINE, colours.UNKNOWN_FILL, INK)


def _box(
    boxes: Sequence[NodeBox], box: NodeBox, x: float, middle: float, size: tuple[float, float]
) -> list[Box | Branch | Words]:
    width, height = size
    top = middle - height / 2
    line, fill, ink = look(box)
    radius = 6.0 if box.kind == "test" else 2.0
    items: list[Box | Branch | Words] = [
        Box(x, top, width, height, fill, line, radius, box.kind == "subtree", box.hint)
    ]
    if len(box.levels) > 1:
        step = (height - 1) / len(box.levels)
        items += [
            Box(x + 0.5, top + 0.5 + i * step, STRIPE - 1, step, colours.level_colour(level))
            for i, level in enumerate(box.levels)
        ]
        x, width = x + STRIPE, width - STRIPE
    y = top + 0.7 * PADDING
    if box.title:
        items.append(Words(x + width / 2, y + TITLE, box.title, TITLE, "middle", True, ink))
        y += TITLE * LINE
    left, right = _columns(box)
    gap = COLUMN_GAP if left and right else 0
    split = x + width / 2 - (left + gap + right) / 2 + left
    for row in box.rows:
        if isinstance(row, str):
            items.append(Words(x + PADDING, y + TEXT, row, TEXT, bold=True, colour=ink))
        else:
            items += [Words(split, y + TEXT, row[0], TEXT, "end", colour=ink)] if row[0] else []
            items += [Words(split + gap, y + TEXT, row[1], TEXT, colour=ink)] if row[1] else []
        y += TEXT * LINE
    if _shows_share(box):
        colour = FAINT if fill == "#ffffff" else ink
        items.append(Words(x + width / 2, y + NOTE, share_text(box, boxes[0]), NOTE, "middle", colour=colour))
    return items
