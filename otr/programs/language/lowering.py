"""From a program's statements to an oblique tree: every way through them is a path to a leaf."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.heads import Argmax, ClipBox, Exp, Identity, TanhBox
from otr.core.tree import ObliqueTree
from otr.errors import ProgramError
from otr.programs.language.evaluation import Evaluator, appended
from otr.programs.language.nesting import Steps, result_of
from otr.programs.language.paths import GrowingTree, Path
from otr.programs.language.scope import Scope
from otr.programs.language.syntax import Assign, Number, Return, Statement, Statements
from otr.programs.language.tokens import Place, Source
from otr.programs.language.values import Affine, Clipped, Exponential, Squashed, Value

MAX_LABELS = 1024  # where they have no names; every leaf has an output for each


@dataclass(slots=True)
class _PathEnd:
    """What a path ends with: the values of its outputs, and where the text says so."""

    path: Path
    values: list[Value]
    at: Place


class Lowering:
    """Makes the tree of a program's statements."""

    def __init__(
        self,
        source: Source,
        scope: Scope,
        n_inputs: int,
        output_names: Sequence[str] | None,
        answers_labels: bool,
        max_leaves: int,
    ) -> None:
        self._source, self._scope, self._n_inputs = source, scope, n_inputs
        self._output_names, self._answers_labels = output_names, answers_labels
        self._tree = GrowingTree(n_inputs, max_leaves)
        self._evaluator = Evaluator(source, scope, self._tree, answers_labels=answers_labels)
        self._answers: list[_PathEnd] = []

    def tree(self, block: Statements) -> ObliqueTree:
        """Return the tree of the statements of a whole program."""
        for path in result_of(self.run(block, [Path((-1, 0), block[0].at)])):
            self.end_of_text(path)
        return self.label_tree() if self._answers_labels else self.value_tree()

    def run(self, block: Statements, paths: list[Path]) -> Steps[list[Path]]:
        """Do a block's statements on each path; return the paths that go on after it."""
        for statement in block:
            after: list[Path] = []
            for path in paths:
                after += yield self._do(statement, path)
            paths = after
        return paths

    def end_of_text(self, path: Path) -> None:
        """Answer with the values of the outputs at the end of the text; raise ProgramError if one has none."""
        names = self._outputs
        missing = [name for name in names if name not in path.values]
        if not names or len(missing) == len(names):
            raise self._source.error(
                "some ways through the program pass this and come to its end without an answer; "
                f"add an 'else', or a 'return' at the end{self._outputs_hint()}",
                path.at,
            )
        if missing:
            raise self._source.error(
                f"ways through the program that pass this give no value to the output {missing[0]!r}", path.at
            )
        self._answer(path, [path.values[name] for name in names], path.at)

    @cached_property
    def _outputs(self) -> Sequence[str]:
        """The variables that hold the answer where a program ends without one."""
        if self._answers_labels:
            return []
        if self._output_names is not None:
            return self._output_names
        numbered = [name for name in self._scope.variables if re.fullmatch("y[0-9]+", name)]
        expected = [f"y{i}" for i in range(len(numbered))]
        beyond = next((name for name in numbered if name not in expected), None)
        if beyond is not None:
            missing = next(name for name in expected if name not in numbered)
            raise self._source.error(
                f"the output {beyond!r} has a value and {missing!r} has none; number the outputs y0, y1, ... without "
                "a gap, or give output_names",
                self._scope.variables[beyond],
            )
        return expected

    def _outputs_hint(self) -> str:
        """Return which names a program may give values to, as the end of a message."""
        if self._answers_labels:
            return ""
        if self._output_names is None:
            return ", or give values to y0, y1, ..."
        return f", or give a value to {' and '.join(self._output_names)}"

    def _do(self, statement: Statement, path: Path) -> Steps[list[Path]]:
        path.at = statement.at
        if isinstance(statement, Assign):
            worth = self._evaluator.value(statement.value, path)
            for own, value in worth:
                own.assign(statement.name, value)
            return [own for own, _ in worth]
        if isinstance(statement, Return):
            return self._return(statement, path)
        after: list[Path] = []
        undecided = [path]
        for condition, block in statement.branches:
            splits = [self._evaluator.decide(condition, own) for own in undecided]
            after += yield self.run(block, [own for split in splits for own in split[0]])
            undecided = [own for split in splits for own in split[1]]
        after += yield self.run(statement.otherwise or [], undecided)
        return after

    def _return(self, statement: Return, path: Path) -> list[Path]:
        for node in statement.values if self._answers_labels else ():
            if isinstance(node, Number):
                self._check_number(node)
        ends: list[tuple[Path, list[Value]]] = [(path, [])]
        for node in statement.values:
            ends = [end for own, values in ends for end in appended(values, self._evaluator.value(node, own))]
        for own, values in ends:
            self._answer(own, values, statement.values[0].at)
        return []

    def _answer(self, path: Path, values: list[Value], at: Place) -> None:
        expected, why = 1, "a program that answers labels has one"
        if not self._answers_labels:
            if self._output_names is not None:
                expected, why = len(self._output_names), f"the outputs are {', '.join(self._output_names)}"
            elif self._answers:
                expected, why = (
                    len(self._answers[0].values),
                    f"as the answer of line {self._answers[0].at.line}",
                )
            else:
                expected = len(values)
        if len(values) != expected:
            raise self._source.error(f"this answer has {len(values)} values, expected {expected}: {why}", at)
        self._answers.append(_PathEnd(path, values, at))

    def label_tree(self) -> ObliqueTree:
        """Return the tree whose leaves have labels; their outputs are 1 for the label, else 0."""
        labels: list[int] = []
        for answer in self._decided(self._answers):
            (value,) = answer.values
            assert isinstance(value, Affine)
            labels.append(self._label(value, answer.at))
            self._tree.end(answer.path, len(labels) - 1)
        n_labels = len(self._output_names) if self._output_names is not None else max(labels) + 1
        c = np.zeros((len(labels), n_labels))
        c[np.arange(len(labels)), labels] = 1.0
        M = np.zeros((len(labels), n_labels, self._n_inputs))
        return ObliqueTree(*self._tree.arrays(), M, c, labels=labels, head=Argmax())

    def _label(self, value: Affine, at: Place) -> int:
        names = self._output_names
        if not value.is_constant:
            raise self._source.error("this answers a value that depends on the inputs where a label was expected", at)
        if value.offset not in range(len(names) if names is not None else MAX_LABELS):
            known = f"0 to {len(names) - 1}, or {', '.join(names)}" if names is not None else "0, 1, ..."
            raise self._source.error(f"{value.offset:g} is no label; labels are {known}", at)
        return int(value.offset)

    def _check_number(self, node: Number) -> None:
        """Raise ProgramError where a number might be a label's position, from 0 on, or its name, as classes 1, 2, 3."""
        names, text = self._output_names or (), f"{node.value:g}"
        if text in names and names.index(text) != node.value:
            raise self._source.error(f"{text} is the name of a label; write it as `{text}`, as a name", node.at)

    def value_tree(self) -> ObliqueTree:
        """Return the tree whose leaves have affine values, under the head that the answers ask for."""
        head: Head = Identity()
        answers = self._answers
        if any(isinstance(value, Squashed) for answer in answers for value in answer.values):
            head = self._tanh_box()
        elif any(isinstance(value, Exponential) for answer in answers for value in answer.values):
            head = self._exp()
        elif (box := self._clip_box()) is not None:
            head = box
        else:
            answers = self._decided(answers)
        n_outputs = len(answers[0].values)
        M, c = np.zeros((len(answers), n_outputs, self._n_inputs)), np.zeros((len(answers), n_outputs))
        for leaf, answer in enumerate(answers):
            self._tree.end(answer.path, leaf)
            for output, value in enumerate(answer.values):
                inner = value if isinstance(value, Affine) else value.inner
                M[leaf, output, list(inner.terms)] = list(inner.terms.values())
                c[leaf, output] = inner.offset
        return ObliqueTree(*self._tree.arrays(), M, c, head=head)

    def _decided(self, answers: list[_PathEnd]) -> list[_PathEnd]:
        """Return the answers with clips decided by tests, which may be several for one."""
        decided: list[_PathEnd] = []
        for answer in answers:
            ends: list[tuple[Path, list[Value]]] = [(answer.path, [])]
            for value in answer.values:
                ends = [
                    end
                    for own, values in ends
                    for end in appended(values, [*self._evaluator.unclipped(own, value, answer.at)])
                ]
            decided += [_PathEnd(path, values, answer.at) for path, values in ends]
        return decided

    def _tanh_box(self) -> TanhBox:
        """Return the head of answers ``half * tanh(...) + middle``; raise ProgramError if an output's differ."""
        boxes: list[tuple[float, float]] = []
        for answer in self._answers:
            for output, value in enumerate(answer.values):
                box = (value.half, value.middle) if isinstance(value, Squashed) else None
                boxes += [box] if box and output == len(boxes) else []
                if box is None or box != boxes[output]:
                    raise self._mixed(answer.at)
        half, middle = (np.array(column) for column in zip(*boxes, strict=True))
        return TanhBox(*_limits(half, middle))

    def _exp(self) -> Exp:
        """Return the head of answers ``exp(...)``; raise ProgramError if one is not of this form."""
        for answer in self._answers:
            if not all(isinstance(value, Exponential) for value in answer.values):
                raise self._source.error("where one answer is an exp all must be, in every leaf", answer.at)
        return Exp()

    def _mixed(self, at: Place) -> ProgramError:
        return self._source.error(
            "where one answer goes through tanh all must, with the same scale and shift in every leaf",
            at,
        )

    def _clip_box(self) -> ClipBox | None:
        """Return the head that clips every output, where all answers of an output are clipped to the same limits.

        A constant within the limits counts as clipped. Other programs have their clips decided by tests.
        """
        boxes: list[tuple[float, float]] = []
        for column in zip(*(answer.values for answer in self._answers), strict=True):
            limits = {(value.low, value.high) for value in column if isinstance(value, Clipped)}
            if len(limits) != 1 or not np.isfinite(list(limits)).all():
                return None
            ((low, high),) = limits
            if any(
                not value.is_constant or not low <= value.offset <= high
                for value in column
                if isinstance(value, Affine)
            ):
                return None
            boxes.append((low, high))
        low, high = np.array(boxes).T
        return ClipBox(low, high)


def _limits(half: FloatArray, middle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return low and high of a `TanhBox`, which takes ``low + half`` for the middle."""
    low = middle - half
    return low, low + 2 * half
