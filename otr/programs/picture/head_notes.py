"""What a head makes of the formulas in a drawn tree's leaves, in words."""

from __future__ import annotations

from functools import singledispatch

from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Exp, Identity, PidBox, Sign, TanhBox
from otr.core.tree import ObliqueTree
from otr.programs.picture.formulas import number_text


def head_note(tree: ObliqueTree) -> str:
    """Return what the head makes of the leaves' formulas; empty where it makes nothing of them."""
    return "" if tree.labels is not None or not tree.M.any() else note_of(tree.head, tree.n_outputs)


@singledispatch
def note_of(head: Head, n_outputs: int) -> str:
    """Return what a head makes of formulas."""
    raise no_entry(head, "a drawn tree")


@note_of.register
def _(head: Identity, n_outputs: int) -> str:
    return ""


@note_of.register
def _(head: Exp, n_outputs: int) -> str:
    return "formulas go through exp"


@note_of.register
def _(head: ClipBox, n_outputs: int) -> str:
    return f"formulas are clipped to {_boxes(head, n_outputs)}"


@note_of.register
def _(head: TanhBox, n_outputs: int) -> str:
    return f"formulas go through tanh, scaled to {_boxes(head, n_outputs)}"


@note_of.register
def _(head: PidBox, n_outputs: int) -> str:
    return f"gains times terms go through tanh, scaled to {_boxes(head, n_outputs)}"


@note_of.register
def _(head: Sign, n_outputs: int) -> str:
    return "a formula answers 1 where it is above 0, else 0"


@note_of.register
def _(head: Argmax, n_outputs: int) -> str:
    return "formulas answer which of the outputs is the largest"


def _boxes(head: ClipBox | TanhBox | PidBox, n_outputs: int) -> str:
    """Return the ranges of the answers, each once."""
    limits = zip(*head.limits(n_outputs), strict=True)
    return ", ".join(dict.fromkeys(f"[{number_text(low, 4)}, {number_text(high, 4)}]" for low, high in limits))
