"""Programs to be read, in text and in LaTeX: the lines of tests and leaves, given how a format writes formulas."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import singledispatch

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.head import Head, no_entry
from otr.core.heads import Argmax, ClipBox, Exp, Identity, PidBox, Sign, TanhBox
from otr.core.tree import ObliqueTree
from otr.programs.names import label_name
from otr.programs.pid_gains import gain_vectors, term_vectors
from otr.programs.walk import affine_expression, walk


@dataclass(frozen=True)
class Notation:
    """How a format writes formulas and statements: templates, in which a formula or a name replaces each %s.

    A vector's lines follow from a name, entries, and whether each entry takes a line of its own.
    """

    number: Callable[[float, int], str]  # from a number and significant digits to text
    vector: Callable[[str, Sequence[str], bool], list[str]]
    times: str  # between a coefficient and its name
    test: str  # the line that asks whether a value is at most 0
    otherwise: str  # the line between the two sides
    returned: str  # the line that answers a value
    label: str  # the one that answers a label
    sign: str  # the one that answers whether a value is above 0
    argmax: str  # the one that answers which of the values with these names is the largest
    assigned: str  # the line that gives a name to a value
    clip: str  # a formula, as the next three
    exp: str
    tanh: str
    product: str
    gain: str  # the name of the gains of a term, for the only action
    gain_of: str  # for a named one


@dataclass(frozen=True)
class Program:
    """A tree to be written in a notation; features, answers and labels have the format's names."""

    tree: ObliqueTree
    notation: Notation
    features: Sequence[str]
    answers: Sequence[str]
    labels: Sequence[str]
    precision: int

    def __post_init__(self) -> None:
        if self.precision < 1:
            raise ValueError(f"precision is {self.precision}, expected at least 1 significant digit")

    def number(self, value: float) -> str:
        """Return a number to so many significant digits."""
        return self.notation.number(value, self.precision)

    def affine(self, coefficients: FloatArray, offset: float, names: Sequence[str] | None = None) -> str:
        """Return ``offset + coefficients @ names``, without zeros and ones; the names are those of inputs if None."""
        names = self.features if names is None else names
        times = self.notation.times
        return affine_expression(coefficients, offset, names, self.number, times=times, tie=" ", leaves_out_ones=True)

    def lines(self) -> list[tuple[int, str]]:
        """Return the program's lines with their depths; raise ValueError if a PID policy's terms differ by leaf."""
        tree, notation = self.tree, self.notation
        lines = [(0, line) for line in self._first_lines()]
        for what, index, depth in walk(tree):
            if what == "if":
                lines.append((depth, notation.test % self.affine(tree.P[index], float(tree.v[index]))))
            elif what == "else":
                lines.append((depth, notation.otherwise))
            elif what == "leaf" and tree.labels is not None:
                lines.append((depth, notation.label % label_name(int(tree.labels[index]), self.labels)))
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
            return [self.notation.returned % values[0]]
        return [self.notation.assigned % pair for pair in zip(self.answers, values, strict=True)]

    def squashed(self, values: Sequence[str]) -> list[str]:
        """Return the formulas of values that go through tanh to the limits of the head."""
        assert isinstance(self.tree.head, TanhBox | PidBox)
        halves, middles = self.tree.head.halves_and_middles(self.tree.n_outputs)
        lines = zip(values, halves, middles.tolist(), strict=True)
        return [self.affine(np.array([half]), middle, [self.notation.tanh % value]) for value, half, middle in lines]

    def _first_lines(self) -> list[str]:
        """Return what is written above the tests: of a PID policy, what its terms are."""
        terms = [] if self.tree.head.acts_by_output else term_vectors(self.tree, self.affine)
        return [line for term, entries in terms for line in self.notation.vector(term, entries, False)]


@singledispatch
def answer_lines(head: Head, program: Program, leaf: int) -> list[str]:
    """Return the lines that state a leaf's answer under a head."""
    raise no_entry(head, "a program to be read")


@answer_lines.register
def _(head: Identity, program: Program, leaf: int) -> list[str]:
    return program.answered(program.outputs(leaf))


@answer_lines.register
def _(head: Exp, program: Program, leaf: int) -> list[str]:
    return program.answered([program.notation.exp % value for value in program.outputs(leaf)])


@answer_lines.register
def _(head: ClipBox, program: Program, leaf: int) -> list[str]:
    low, high = (limit.tolist() for limit in head.limits(program.tree.n_outputs))
    values = zip(program.outputs(leaf), map(program.number, low), map(program.number, high), strict=True)
    return program.answered([program.notation.clip % each for each in values])


@answer_lines.register
def _(head: TanhBox, program: Program, leaf: int) -> list[str]:
    return program.answered(program.squashed(program.outputs(leaf)))


@answer_lines.register
def _(head: PidBox, program: Program, leaf: int) -> list[str]:
    """Return the lines of the gains theta, a vector that varies with the state an entry a line, then the actions."""
    lines, controls, notation = [], [], program.notation
    for action, answer in enumerate(program.answers):
        products = []
        for term, entries, varies in gain_vectors(program.tree, leaf, action, program.affine):
            gain = notation.gain_of % (term, answer) if len(program.answers) > 1 else notation.gain % term
            lines += notation.vector(gain, entries, varies)
            products.append(notation.product % (gain, term))
        controls.append(" + ".join(products))
    return [*lines, *program.answered(program.squashed(controls))]


@answer_lines.register
def _(head: Sign, program: Program, leaf: int) -> list[str]:
    return [program.notation.sign % program.outputs(leaf)[0]]


@answer_lines.register
def _(head: Argmax, program: Program, leaf: int) -> list[str]:
    names, notation = program.answers, program.notation
    assigned = [notation.assigned % pair for pair in zip(names, program.outputs(leaf), strict=True)]
    return [*assigned, notation.argmax % ", ".join(names)]
