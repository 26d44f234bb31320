"""Programs to be read, in text and in LaTeX: the lines of tests and leaves, given how a format writes formulas."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import singledispatch

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.head import Argmax, ClipBox, Head, Identity, PidBox, Sign, TanhBox, no_entry
from otr.core.tree import ObliqueTree
from otr.programs.names import label_name
from otr.programs.pid_gains import gain_vectors, term_vectors
from otr.programs.walk import affine_expression, walk

__all__ = ["Notation", "answer_lines"]


class Notation(ABC):
    """How a format writes a tree's formulas and statements.

    Attributes:
        tree: any tree.
        features, answers: names of the inputs and of the answer's values, as they stand in formulas.
        labels: names of the labels, as they stand in formulas.
        precision: significant digits.
        times: stands between a coefficient and its name.
    """

    times: str

    def __init__(
        self,
        tree: ObliqueTree,
        features: Sequence[str],
        answers: Sequence[str],
        labels: Sequence[str],
        precision: int,
    ) -> None:
        """Keep what a program is written of.

        Raises:
            ValueError: precision < 1.
        """
        if precision < 1:
            raise ValueError(f"precision is {precision}, expected at least 1 significant digit")
        self.tree, self.precision = tree, precision
        self.features, self.answers, self.labels = features, answers, labels

    @abstractmethod
    def number(self, value: float) -> str:
        """Return a number to so many significant digits."""

    @abstractmethod
    def test(self, value: str) -> str:
        """Return the line that asks whether a value is at most 0."""

    @abstractmethod
    def otherwise(self) -> str:
        """Return the line between the two sides of a test."""

    @abstractmethod
    def returned(self, value: str) -> str:
        """Return the line that answers a value."""

    @abstractmethod
    def returned_label(self, name: str) -> str:
        """Return the line that answers a label."""

    @abstractmethod
    def returned_sign(self, value: str) -> str:
        """Return the line that answers 1 where a value is above 0, else 0."""

    @abstractmethod
    def returned_argmax(self, names: Sequence[str]) -> str:
        """Return the line that answers which of the named values is the largest."""

    @abstractmethod
    def assigned(self, name: str, value: str) -> str:
        """Return the line that gives a name to a value."""

    @abstractmethod
    def clip(self, value: str, low: float, high: float) -> str:
        """Return the formula of a clipped value."""

    @abstractmethod
    def tanh(self, value: str) -> str:
        """Return the formula of a value's tanh."""

    @abstractmethod
    def vector(self, name: str, entries: Sequence[str], *, one_a_line: bool) -> list[str]:
        """Return the lines that give a name to a vector, in one line or with a line for each entry."""

    @abstractmethod
    def gain(self, term: str, answer: str) -> str:
        """Return the name of the gains of a term, for a named answer or, where there is one only, for ""."""

    @abstractmethod
    def product(self, gain: str, term: str) -> str:
        """Return the formula of an inner product."""

    def affine(self, coefficients: FloatArray, offset: float, names: Sequence[str] | None = None) -> str:
        """Return ``offset + coefficients @ names``, without zeros and ones; the names are those of inputs if None."""
        names = self.features if names is None else names
        return affine_expression(
            coefficients, offset, names, self.number, times=self.times, tie=" ", leaves_out_ones=True
        )

    def lines(self) -> list[tuple[int, str]]:
        """Return the lines of the program, each with its depth.

        Raises:
            ValueError: the tree is a PID policy whose terms differ between leaves.
        """
        tree, lines = self.tree, [(0, line) for line in _first_lines(self.tree.head, self)]
        for what, index, depth in walk(tree):
            if what == "if":
                lines.append((depth, self.test(self.affine(tree.P[index], float(tree.v[index])))))
            elif what == "else":
                lines.append((depth, self.otherwise()))
            elif what == "leaf" and tree.labels is not None:
                lines.append((depth, self.returned_label(label_name(int(tree.labels[index]), self.labels))))
            elif what == "leaf":
                lines += [(depth, line) for line in answer_lines(tree.head, self, index)]
        return lines

    def outputs(self, leaf: int) -> list[str]:
        """Return the formulas of a leaf's outputs."""
        maps = zip(self.tree.M[leaf], self.tree.c[leaf].tolist(), strict=True)
        return [self.affine(row, offset) for row, offset in maps]

    def answered(self, values: Sequence[str]) -> list[str]:
        """Return the lines that answer values: one is returned, several are given to their names."""
        if len(values) == 1:
            return [self.returned(values[0])]
        return [self.assigned(name, value) for name, value in zip(self.answers, values, strict=True)]

    def squashed(self, values: Sequence[str]) -> list[str]:
        """Return the formulas of values that go through tanh to the limits of the head."""
        limits = self.tree.head.limits(self.tree.n_outputs)
        assert limits is not None
        lines = zip(values, (limits[1] - limits[0]) / 2, ((limits[1] + limits[0]) / 2).tolist(), strict=True)
        return [self.affine(np.array([half]), middle, [self.tanh(value)]) for value, half, middle in lines]


def _first_lines(head: Head, notation: Notation) -> list[str]:
    """Return what stands above the tests: of a PID policy, what its terms are."""
    if head.acts_by_output:
        return []
    terms = term_vectors(notation.tree, notation.affine)
    return [line for term, entries in terms for line in notation.vector(term, entries, one_a_line=False)]


@singledispatch
def answer_lines(head: Head, notation: Notation, leaf: int) -> list[str]:
    """Return the lines that state a leaf's answer under a head."""
    raise no_entry(head, "a program to be read")


@answer_lines.register
def _(head: Identity, notation: Notation, leaf: int) -> list[str]:
    return notation.answered(notation.outputs(leaf))


@answer_lines.register
def _(head: ClipBox, notation: Notation, leaf: int) -> list[str]:
    low, high = (limit.tolist() for limit in head.limits(notation.tree.n_outputs))
    return notation.answered(list(map(notation.clip, notation.outputs(leaf), low, high)))


@answer_lines.register
def _(head: TanhBox, notation: Notation, leaf: int) -> list[str]:
    return notation.answered(notation.squashed(notation.outputs(leaf)))


@answer_lines.register
def _(head: PidBox, notation: Notation, leaf: int) -> list[str]:
    """Return the lines of the gains theta, a vector that varies with the state an entry a line, then the actions."""
    lines, controls = [], []
    for action, answer in enumerate(notation.answers):
        products = []
        for term, entries, varies in gain_vectors(notation.tree, leaf, action, notation.affine):
            gain = notation.gain(term, answer if len(notation.answers) > 1 else "")
            lines += notation.vector(gain, entries, one_a_line=varies)
            products.append(notation.product(gain, term))
        controls.append(" + ".join(products))
    return [*lines, *notation.answered(notation.squashed(controls))]


@answer_lines.register
def _(head: Sign, notation: Notation, leaf: int) -> list[str]:
    return [notation.returned_sign(notation.outputs(leaf)[0])]


@answer_lines.register
def _(head: Argmax, notation: Notation, leaf: int) -> list[str]:
    assigned = map(notation.assigned, notation.answers, notation.outputs(leaf))
    return [*assigned, notation.returned_argmax(notation.answers)]
