"""What several program formats share: names, the walk over a tree, rows that are stored once, what a head needs."""

from __future__ import annotations

import re
import textwrap
import unicodedata
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from otr.arrays import FloatArray, IntArray
from otr.head import Argmax, ClipBox, Head, PidBox, Sign, TanhBox
from otr.network import ReluNetwork
from otr.programs.gains import pid_output_names
from otr.programs.text import names_of
from otr.tree import ObliqueTree

__all__ = [
    "MAX_NESTED_DEPTH",
    "TIE",
    "WIDTH",
    "Names",
    "affine_expression",
    "box_limits",
    "check_policy",
    "child",
    "distinct_rows",
    "give_labels",
    "identifiers",
    "label_name",
    "names_for",
    "one_line",
    "summary_of",
    "walk",
    "wrapped",
]

# Nested ifs up to this depth; Python's parser bears 100 indentations, and nobody reads as many.
MAX_NESTED_DEPTH = 64
WIDTH = 110  # of a line of code
TIE = "\u00a0"  # a space at which `wrapped` breaks no line


@dataclass(frozen=True)
class Names:
    """What a program calls things: names as given, and identifiers of the language made from them.

    Attributes:
        features, answers: as given.
        feature_ids, output_ids: identifiers for the inputs and for the affine outputs.
        answer_ids: identifiers for the values of the answer; the outputs' own, but for gains and terms.
    """

    features: list[str]
    answers: list[str]
    feature_ids: list[str]
    output_ids: list[str]
    answer_ids: list[str]


def names_for(
    tree: ObliqueTree,
    feature_names: Sequence[str] | None,
    output_names: Sequence[str] | None,
    *,
    reserved: Collection[str] = (),
    ignore_case: bool = False,
) -> Names:
    """Return the names of a tree's inputs and answers, and identifiers for its inputs and its affine outputs.

    The identifiers of the outputs are made from `output_names` where these name outputs, and are y0, y1, ... where
    they name labels; the terms and gains of a PID policy are P0, ..., theta_P0, ... No two identifiers are the same.

    Raises:
        TypeError: `tree` is no ObliqueTree.
        ValueError: the wrong number of names, or a tree without inputs.
    """
    if not isinstance(tree, ObliqueTree):
        raise TypeError(f"tree is a {type(tree).__name__}, expected an ObliqueTree; a PatternTree has to_tree()")
    check_policy(tree)
    features, answers = names_of(tree, feature_names, output_names)
    outputs = [f"y{i}" for i in range(tree.n_outputs)] if give_labels(tree) else answers
    joined = pid_output_names(tree, answers) if isinstance(tree.head, PidBox) else []
    fallbacks = [f"x{i}" for i in range(len(features))] + [f"y{i}" for i in range(len(outputs) + len(joined))]
    made = identifiers([*features, *outputs, *joined], fallbacks, reserved=reserved, ignore_case=ignore_case)
    d, o = len(features), len(features) + len(outputs)
    return Names(features, answers, made[:d], made[o:] if joined else made[d:o], made[d:o])


def check_policy(policy: ObliqueTree | ReluNetwork) -> None:
    """Raise ValueError for a policy that no format has a form for: without inputs."""
    if policy.n_inputs == 0:
        raise ValueError("the tree has no inputs; a program needs at least one")


def give_labels(policy: ObliqueTree | ReluNetwork) -> bool:
    """Return whether the answers of a tree or network are labels."""
    decided = isinstance(policy, ObliqueTree) and policy.labels is not None
    return decided or isinstance(policy.head, Sign | Argmax)


def label_name(label: int, answers: Sequence[str]) -> str:
    """Return a label's name, or its number where it has none."""
    return answers[label] if 0 <= label < len(answers) else str(label)


def identifiers(
    names: Sequence[str], fallbacks: Sequence[str], *, reserved: Collection[str] = (), ignore_case: bool = False
) -> list[str]:
    """Return an identifier for each name: ASCII letters, digits and single underscores, a letter first, all distinct.

    A name that already is one, and taken by nobody, stays as it is. Accents are dropped, what is neither letter nor
    digit becomes an underscore, and a number is appended to what is taken or reserved.

    Args:
        names: any text.
        fallbacks: what to call a name of which nothing is left.
        reserved: words of the language and what else the program uses.
        ignore_case: whether names that differ in case alone are the same.
    """
    key = str.lower if ignore_case else str
    plain = [_plain(name, fallback) for name, fallback in zip(names, fallbacks, strict=True)]
    kept = {key(name) for name, simple in zip(names, plain, strict=True) if name == simple}
    taken = {key(word) for word in reserved}
    made = []
    for name, simple in zip(names, plain, strict=True):
        identifier, n = simple, 1
        # Another name's own spelling is left to that name.
        while key(identifier) in taken or (identifier != name and key(identifier) in kept):
            n += 1
            identifier = f"{simple}_{n}"
        taken.add(key(identifier))
        made.append(identifier)
    return made


def _plain(name: str, fallback: str) -> str:
    ascii_only = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    simple = re.sub(r"[^A-Za-z0-9]+", "_", ascii_only).strip("_")
    if not simple:
        return fallback
    return simple if simple[0].isalpha() else f"{fallback[0]}_{simple}"


def one_line(name: str) -> str:
    """Return a name for a comment: line breaks and control characters become spaces."""
    return " ".join("".join(" " if unicodedata.category(c)[0] in "CZ" else c for c in name).split())


def summary_of(tree: ObliqueTree) -> str:
    """Return what a program's first line says of the tree."""
    leaves = "1 leaf" if tree.n_leaves == 1 else f"{tree.n_leaves:,} leaves"
    return f"an oblique decision tree of depth {tree.depth} with {leaves}"


def walk(tree: ObliqueTree) -> Iterator[tuple[Literal["if", "else", "end", "leaf"], int, int]]:
    """Yield (what, node or leaf, depth) in the order in which nested ifs are written, however deep the tree is."""
    pending: list[tuple[Literal["if", "else", "end", "leaf"], int, int]] = [_event(0 if tree.n_nodes else ~0, 0)]
    while pending:
        what, index, depth = pending.pop()
        yield what, index, depth
        if what == "if":
            pending.append(("end", index, depth))
            pending.append(_event(int(tree.children_right[index]), depth + 1))
            pending.append(("else", index, depth))
            pending.append(_event(int(tree.children_left[index]), depth + 1))


def _event(reference: int, depth: int) -> tuple[Literal["if", "leaf"], int, int]:
    return ("if", reference, depth) if reference >= 0 else ("leaf", ~reference, depth)


def child(tree: ObliqueTree) -> IntArray:
    """Return the references of the children, (n_nodes, 2): left, right."""
    return np.stack((tree.children_left, tree.children_right), axis=1)


def distinct_rows(rows: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct rows in the order in which they first occur, and for each row which of them it is."""
    unique, first, index = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return unique[order], rank[index.reshape(-1)]


def box_limits(head: Head, n_outputs: int) -> tuple[FloatArray, FloatArray]:
    """Return a box head's limits for every value of the answer: low and high, (n_answers,) each."""
    n_answers = head.n_answers(n_outputs)
    assert isinstance(head, ClipBox | TanhBox | PidBox)
    return np.broadcast_to(head.low, (n_answers,)), np.broadcast_to(head.high, (n_answers,))


def affine_expression(
    coefficients: FloatArray, offset: float, names: Sequence[str], number: Callable[[float], str]
) -> str:
    """Return ``offset + coefficient * name - ...`` in the notation of most languages; zeros are left out.

    The spaces within a term are ties.
    """
    terms = [] if offset == 0 else [(float(offset), "")]
    terms += [(float(coefficients[i]), f"{TIE}*{TIE}{names[i]}") for i in np.flatnonzero(coefficients).tolist()]
    if not terms:
        return number(0.0)
    (first, name), *rest = terms
    signed = (f" {'-' if value < 0 else '+'}{TIE}{number(abs(value))}{name}" for value, name in rest)
    return f"{number(first)}{name}{''.join(signed)}"


def wrapped(text: str, indent: str) -> list[str]:
    """Return code as lines of at most WIDTH, broken at spaces, the further ones indented by eight more."""
    lines = textwrap.wrap(
        text,
        width=max(WIDTH, len(indent) + 60),
        initial_indent=indent,
        subsequent_indent=f"{indent}        ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace(TIE, " ") for line in lines]
