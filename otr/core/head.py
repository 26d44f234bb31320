"""Heads: from a policy's affine outputs y (n, o) to its answers.

A head that decides a label (`Sign`, `Argmax`) does so by affine tests on y, which OTR appends to the tree below the
tests of the hidden neurons (Orfanos 2023, section on classification). The other heads leave the tree as it is and are
applied to the value of the leaf.

A head is defined here; how a format writes its answers, and how a proof bounds them, is one entry for each head
there: the functions that `functools.singledispatch` chooses by the head's class in `otr.programs` and `otr.proof`.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.errors import InvalidNetworkError


class Head(ABC):
    """The last step of a policy; two heads are equal when their `to_dict` are.

    Attributes:
        name: in files.
        acts_by_output: whether an action is a function of one output alone, which never falls as that rises.
        gives_labels: whether the answer is a label.
        is_projection: whether the head leaves its own answers as they are: h(h(y)) = h(y).
        words: what the head makes of the outputs, as text; of a head with limits, what comes before these.
    """

    name: str
    acts_by_output = True
    gives_labels = False
    is_projection = False
    words = ""

    @abstractmethod
    def __call__(self, Y: FloatArray) -> NDArray[Any]:
        """Return the answers for affine outputs Y of shape (n, o) or (o,)."""

    def check(self, n_outputs: int) -> None:
        """Raise InvalidNetworkError unless the head fits `n_outputs` affine outputs."""
        if n_outputs < 1:
            raise InvalidNetworkError(f"{type(self).__name__} needs at least 1 output, the network has {n_outputs}")

    def controls(self, Y: FloatArray) -> FloatArray:
        """Return what the head clips, squashes or compares, (n, a) or (a,): outputs Y themselves but for `PidBox`."""
        return Y

    def n_answers(self, n_outputs: int) -> int:
        """Return how many numbers, or labels, are named in a printed answer."""
        return n_outputs

    def n_terms(self, n_outputs: int) -> int:
        """Return how many of the first outputs are terms that the others weigh (`PidBox`); 0 for all other heads."""
        return 0

    def n_labels(self, n_outputs: int) -> int:
        """Return how many labels there are, where the answers are labels."""
        return self.n_answers(n_outputs)

    def output_names(self, n_outputs: int, answers: Sequence[str]) -> list[str]:
        """Return names of the outputs where these are other things than the named answers; else none."""
        return []

    def limits(self, n_outputs: int) -> tuple[FloatArray, FloatArray] | None:
        """Return the box of the answers, low and high of shape (n_answers,) each; None for a head without one."""
        return None

    def in_words(self, n_outputs: int) -> str:
        """Return what the head makes of the outputs, as text."""
        limits, words = self.limits(n_outputs), self.words or type(self).__name__
        if limits is None:
            return words
        ranges = [f"{low:.4g} .. {high:.4g}" for low, high in zip(*limits, strict=True)]
        return f"{words} {', '.join(ranges if len(set(ranges)) > 1 else ranges[:1])}"

    def clip(self) -> Head | None:
        """Return the head that clips to the box of the answers; None for a head without one."""
        return None

    def slopes(self, n_outputs: int) -> FloatArray | None:
        """Return the steepest slope of each answer in its own output (n_outputs,); None where there is none."""
        return None

    def weights_of_label(self, label: int, n_outputs: int) -> FloatArray:
        """Return a label as the vector (n_outputs,) that a linear condition weighs: 1 at the label, else 0.

        Raises:
            ValueError: the label is none of the outputs.
        """
        if not 0 <= label < n_outputs:
            raise ValueError(f"the label {label} is none of the {n_outputs} outputs that a condition weighs")
        return np.asarray(np.eye(n_outputs)[label])

    def clipped_to(self, low: FloatArray, high: FloatArray) -> Head:
        """Return the head whose answers are this one's, clipped to the box [low, high] of shape (o,) each.

        Raises:
            ValueError: there is no such head.
        """
        raise ValueError(f"no head clips the answers of {self!r} to a box")

    def tangent(self, n_outputs: int) -> tuple[FloatArray, FloatArray] | None:
        """Return slopes and values (n_outputs,) of squashed answers at y = 0; None for a head that squashes nothing."""
        return None

    def n_tests(self, n_outputs: int) -> int:
        """Return the number of tests on y that decide the label; 0 for a head without labels."""
        return 0

    def tests(self, Y: FloatArray) -> BoolArray:
        """Return the outcomes, True is right, of the head's tests: (n, n_tests)."""
        return np.zeros((len(Y), 0), dtype=np.bool_)

    def labels(self, outcomes: BoolArray) -> IntArray | None:
        """Return the label (n,) that test outcomes (n, n_tests) lead to; None for a head without labels."""
        return None

    def champions(self, outcomes: BoolArray) -> IntArray:
        """Return, for every test, the output subtracted in it: test k asks `y_(challenger k) - y_(champion) <= 0`.

        Args:
            outcomes: (n, n_tests); the champion of test k depends on the outcomes before k only.

        Returns:
            (n, n_tests) output indices; -1 where nothing is subtracted.
        """
        return np.zeros(outcomes.shape, dtype=np.int64)

    @property
    def first_challenger(self) -> int:
        """Output that the head's first test asks about; test k asks about `first_challenger + k`."""
        return 0

    def next_test(self, outputs: FloatArray, outcomes: BoolArray) -> FloatArray:
        """Return the affine form of the test that comes after k others.

        Args:
            outputs: (n, o, d + 1) affine forms of the outputs.
            outcomes: (n, k) of the tests before.

        Returns:
            (n, d + 1)
        """
        n, k = outcomes.shape
        champions = self.champions(np.column_stack((outcomes, np.zeros((n, 1), dtype=np.bool_))))[:, k]
        test: FloatArray = outputs[:, self.first_challenger + k].copy()
        beaten = np.flatnonzero(champions >= 0)
        test[beaten] -= outputs[beaten, champions[beaten]]
        return test

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description, read back by `head_from_dict`."""
        return {"name": self.name}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Head) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash(json.dumps(self.to_dict(), sort_keys=True))

    def __repr__(self) -> str:
        arguments = ", ".join(f"{key}={value}" for key, value in self.to_dict().items() if key != "name")
        return f"{type(self).__name__}({arguments})"


def no_entry(head: Head, what: str) -> TypeError:
    """Return the error for a head that a format, or a proof, has no entry for."""
    return TypeError(f"{what} has no entry for the head {type(head).__name__}; register one next to the other heads'")
