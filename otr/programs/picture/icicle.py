"""A tree of many leaves as an icicle: a column a depth, and a leaf a bar to the right edge, as high as its share."""

from __future__ import annotations

from collections.abc import Sequence

from otr.programs.picture import colours
from otr.programs.picture.boxes import NodeBox, share_text
from otr.programs.picture.branches import HEADING, LINE, MARGIN, NOTE, look
from otr.programs.picture.scene import FAINT, INK, Box, Branch, Scene, Words, text_width

TEXT = 7.0
HEIGHT, LEAST, NEVER, MOST = 460.0, 2.4, 1.2, 12.0  # of all states together, and of a leaf
COLUMNS, NARROWEST, WIDEST, LEAVES = 900.0, 26.0, 150.0, 140.0
GAP = 1.0


def icicle(boxes: Sequence[NodeBox], title: str, notes: Sequence[str]) -> Scene:
    """Return the scene of boxes, parents before children, with a title above and a legend and notes below."""
    depths = [0] * len(boxes)
    for i, box in enumerate(boxes):
        for child in box.children:
            depths[child] = depths[i] + 1
    heights = _heights(boxes)
    top = MARGIN + (HEADING * 1.8 if title else 0)
    tops = [top] * len(boxes)
    for i, box in enumerate(boxes):
        if box.children:
            tops[box.children[0]], tops[box.children[1]] = tops[i], tops[i] + heights[box.children[0]]
    n_columns = max(depths)  # of tests
    column = min(max(COLUMNS / n_columns, NARROWEST), WIDEST)
    right = MARGIN + n_columns * column + LEAVES
    items: list[Box | Branch | Words] = (
        [Words(MARGIN, MARGIN + HEADING * 0.9, title, HEADING, bold=True)] if title else []
    )
    for i, box in enumerate(boxes):
        x = MARGIN + depths[i] * column
        width = column if box.children else right - x
        items += _cell(boxes[0], box, x, tops[i], width - GAP, heights[i])
    bottom = top + heights[0]
    for note in ["left to right, test by test; the upper part is where a test holds", *notes]:
        bottom += NOTE * 1.6
        items.append(Words(MARGIN, bottom + NOTE * 0.6, note, NOTE, colour=FAINT))
    bottom += NOTE * 0.6
    labels = {box.label: box for box in boxes if box.label is not None}
    x = MARGIN
    for label in sorted(labels):
        items.append(Box(x, bottom + 7, 9, 9, look(labels[label])[1], look(labels[label])[0]))
        items.append(Words(x + 13, bottom + 14, labels[label].title, TEXT))
        x += 13 + text_width(labels[label].title, TEXT) + 14
    bottom += 16 if labels else 0
    return Scene(max(right, x) + MARGIN, bottom + MARGIN, title or "a decision tree", tuple(items))


def _heights(boxes: Sequence[NodeBox]) -> list[float]:
    """Return how high each box is: a leaf by its share of the states, a test as what is below it."""
    n_leaves = sum(not box.children for box in boxes)
    n_all = boxes[0].n_rows or 0
    equal = min(max(HEIGHT * 2 / n_leaves, LEAST), MOST)
    heights = [0.0] * len(boxes)
    for i in reversed(range(len(boxes))):
        box = boxes[i]
        if box.children:
            heights[i] = sum(heights[child] for child in box.children)
        else:
            visited = LEAST + HEIGHT * box.n_rows / n_all if n_all and box.n_rows else NEVER
            heights[i] = visited if n_all else equal
    return heights


def _cell(root: NodeBox, box: NodeBox, x: float, top: float, width: float, height: float) -> list[Box | Branch | Words]:
    gap = min(GAP, height * 0.2)
    _, fill, ink = look(box)
    share = share_text(box, root)
    hint = f"{box.hint} · {share}" if share else box.hint
    inside = height - gap
    if len(box.levels) > 1:
        stripe = 10.0
        items: list[Box | Branch | Words] = [Box(x, top, width, inside, "#f4f5f6", hint=hint)]
        for i, level in enumerate(box.levels):
            items.append(Box(x + i * stripe, top, stripe, inside, colours.level_colour(level)))
        x, width, ink = x + len(box.levels) * stripe, width - len(box.levels) * stripe, INK
    else:
        items = [Box(x, top, width, inside, "#eceff2" if box.kind == "test" else fill, hint=hint)]
    if inside < TEXT * 1.15 or width < 12:
        return items
    lines = _fitting(box, share, width - 6, inside)
    y = top + inside / 2 - len(lines) * TEXT * LINE / 2 + TEXT
    for text in lines:
        items.append(Words(x + 3, y, text, TEXT, colour=ink))
        y += TEXT * LINE
    return items


def _fitting(box: NodeBox, share: str, width: float, height: float) -> list[str]:
    """Return the most that there is room for: all lines of a test, or as many terms in one as fit; nothing at least."""
    rows = [row if isinstance(row, str) else " ".join(part for part in row if part) for row in box.rows]
    if box.kind == "leaf" and share:
        choices = [*([f"{text}  ·  {share}"] for text in box.shorter), *([text] for text in box.shorter)]
    else:
        names = [row[1] for row in box.rows[:-1] if not isinstance(row, str)]
        choices = [[text] for text in box.shorter[:1]]
        choices += [rows] if len(rows) > 1 else []
        choices += [[text] for text in box.shorter[1:-1]]
        choices += [names[:n] for n in range(len(names), 1, -1)]
        choices += [[text] for text in box.shorter[-1:]]
    for lines in choices:
        if len(lines) * TEXT * LINE <= height + 2 and all(text_width(text, TEXT) <= width for text in lines):
            return lines
    return []
