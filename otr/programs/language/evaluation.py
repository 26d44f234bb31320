"""What expressions are worth and where conditions hold, path by path."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

from otr.programs.language.paths import GrowingTree, Path
from otr.programs.language.scope import Scope
from otr.programs.language.syntax import (
    BooleanExpression,
    Call,
    Chain,
    Choice,
    Comparison,
    Expression,
    Logic,
    Name,
    Number,
)
from otr.programs.language.tokens import Place, Source
from otr.programs.language.values import Affine, Clipped, Exponential, Squashed, Value, clipped, constant

ONLY_LAST = "tanh may only be scaled and shifted by constants, as the last step of an answer"
EXP_IS_LAST = "exp may only be the whole of an answer; add the logarithm of a factor to its argument"
NOT_AFFINE = {
    "*": "this multiplies two values that depend on the inputs, which is not affine; one factor must be constant",
    "/": "this divides by a value that depends on the inputs, which is not affine; divide by constants only",
}
Worth = list[tuple[Path, Value]]
AffineWorth = list[tuple[Path, Affine]]
V = TypeVar("V", bound=Affine | Squashed)
T = TypeVar("T")
Split = tuple[list[Path], list[Path]]


class Evaluator:
    """Evaluates on paths. What is decided on the way (`max`, a condition) divides a path, so one becomes several.

    A comparison becomes the test of the tree, ``P @ x + v <= 0`` to the left, without a change of what holds on its
    boundary: ``a <= b`` is ``a - b <= 0``, and ``a < b`` is that ``b - a <= 0`` does not hold.
    """

    def __init__(self, source: Source, scope: Scope, tree: GrowingTree, *, answers_labels: bool) -> None:
        self._source, self._scope, self._tree = source, scope, tree
        self._answers_labels = answers_labels

    def value(self, node: Expression, path: Path) -> Worth:
        """Return what an expression is worth, on each of the paths that `path` becomes."""
        if isinstance(node, Number):
            return [(path, constant(node.value))]
        if isinstance(node, Name):
            return [(path, self._named(node, path))]
        if isinstance(node, Chain):
            return self._chain(node, path)
        if isinstance(node, Choice):
            holds, fails = self.decide(node.condition, path)
            return [
                worth
                for expression, paths in ((node.first, holds), (node.second, fails))
                for own in paths
                for worth in self.value(expression, own)
            ]
        return self._call(node, path)

    def affine(self, node: Expression, path: Path) -> AffineWorth:
        """Return the same with clips decided, so that only affine values are left."""
        return [decided for own, value in self.value(node, path) for decided in self.unclipped(own, value, node.at)]

    def unclipped(self, path: Path, value: Value, at: Place) -> AffineWorth:
        """Return a value with its clip decided by tests; raise ProgramError if it is a tanh or an exp."""
        if isinstance(value, Squashed | Exponential):
            raise self._source.error(ONLY_LAST if isinstance(value, Squashed) else EXP_IS_LAST, at)
        if isinstance(value, Affine):
            return [(path, value)]
        worth: AffineWorth = []
        inside: Path | None = path
        if value.low > -math.inf:
            form = self._finite(value.inner.minus(constant(value.low)), at)
            below, inside = self._tree.divide(path, form)
            if below:
                worth.append((below, constant(value.low)))
        if inside and value.high < math.inf:
            form = self._finite(value.inner.minus(constant(value.high)), at)
            inside, above = self._tree.divide(inside, form)
            if above:
                worth.append((above, constant(value.high)))
        return [(inside, value.inner), *worth] if inside else worth

    def decide(self, node: BooleanExpression, path: Path) -> Split:
        """Return the paths on which a condition holds, and those on which it does not."""
        if isinstance(node, Comparison):
            return self._comparison(node, path)
        if isinstance(node, Logic):
            return self._logic(node, path)
        holds, fails = self.decide(node.operand, path)
        return fails, holds

    def _logic(self, node: Logic, path: Path) -> Split:
        settled: list[Path] = []
        undecided = [path]
        for operand in node.operands:
            splits = [self.decide(operand, own) for own in undecided]
            goes_on = 0 if node.word == "and" else 1
            undecided = [own for split in splits for own in split[goes_on]]
            settled += [own for split in splits for own in split[1 - goes_on]]
        return (undecided, settled) if node.word == "and" else (settled, undecided)

    def _comparison(self, node: Comparison, path: Path) -> Split:
        fails: list[Path] = []
        holds: list[Path] = []
        for start, values in self._several(node.operands, path):
            undecided = [start]
            for sign, left, right in zip(node.signs, values, values[1:], strict=False):
                splits = [self._compared(own, sign, left, right, node.at) for own in undecided]
                undecided = [own for split in splits for own in split[0]]
                fails += [own for split in splits for own in split[1]]
            holds += undecided
        return holds, fails

    def _compared(self, path: Path, sign: str, left: Affine, right: Affine, at: Place) -> Split:
        if sign in ("==", "!="):
            holds, fails = self._compared(path, "<=", left, right, at)
            splits = [self._compared(own, ">=", left, right, at) for own in holds]
            equal = [own for split in splits for own in split[0]]
            unequal = [*fails, *(own for split in splits for own in split[1])]
            return (equal, unequal) if sign == "==" else (unequal, equal)
        is_swapped = sign in (">=", "<")
        form = right.minus(left) if is_swapped else left.minus(right)
        below, above = ([own] if own else [] for own in self._tree.divide(path, self._finite(form, at)))
        return (below, above) if sign in ("<=", ">=") else (above, below)

    def _several(self, nodes: Sequence[Expression], path: Path) -> list[tuple[Path, list[Affine]]]:
        """Return what several expressions are worth, on each of the paths that all of them make of one."""
        worth: list[tuple[Path, list[Affine]]] = [(path, [])]
        for node in nodes:
            after: list[tuple[Path, list[Affine]]] = []
            for own, before in worth:
                after += appended(before, self.affine(node, own))
            worth = after
        return worth

    def _named(self, node: Name, path: Path) -> Value:
        if node.text in self._scope.features:
            return Affine({self._scope.features[node.text]: 1.0}, 0.0)
        if node.text in path.values:
            return path.values[node.text]
        if node.text in self._scope.labels:
            return constant(float(self._scope.labels[node.text]))
        line = self._scope.variables[node.text].line
        raise self._source.error(
            f"{node.text!r} has no value on some ways to here, which pass by line {line}; give it one before the 'if'",
            node.at,
        )

    def _chain(self, node: Chain, path: Path) -> Worth:
        """A sum or a product, once all operands are known: a sum of thousands is added up in one go."""
        worth: list[tuple[Path, list[Affine | Squashed]]] = [(path, [])]
        for operand in (node.first, *(operand for _, operand, _ in node.rest)):
            after: list[tuple[Path, list[Affine | Squashed]]] = []
            for own, before in worth:
                after += appended(before, self._operand(operand, own))
            worth = after
        result = self._sum if node.is_sum else self._product
        return [(own, result(values, node)) for own, values in worth]

    def _operand(self, node: Expression, path: Path) -> list[tuple[Path, Affine | Squashed]]:
        ends: list[tuple[Path, Affine | Squashed]] = []
        for own, value in self.value(node, path):
            ends += [(own, value)] if isinstance(value, Squashed) else self.unclipped(own, value, node.at)
        return ends

    def _sum(self, values: Sequence[Affine | Squashed], node: Chain) -> Value:
        signs = [1.0, *(1.0 if operator == "+" else -1.0 for operator, _, _ in node.rest)]
        squashed = [i for i, value in enumerate(values) if isinstance(value, Squashed)]
        affine = [(sign, value) for sign, value in zip(signs, values, strict=True) if isinstance(value, Affine)]
        total = self._finite(Affine.sum(affine), node.at)
        if not squashed:
            return total
        only = values[squashed[0]]
        if len(squashed) > 1 or not total.is_constant or not isinstance(only, Squashed):
            raise self._source.error(ONLY_LAST, node.rest[max(squashed[-1] - 1, 0)][2])
        return self._finite(only.signed(signs[squashed[0]]).plus(total.offset), node.at)

    def _product(self, values: Sequence[Affine | Squashed], node: Chain) -> Value:
        result = values[0]
        for (operator, _, at), factor in zip(node.rest, values[1:], strict=True):
            if operator == "*" and isinstance(result, Affine) and result.is_constant:
                result, factor = factor, result
            if not (isinstance(factor, Affine) and factor.is_constant):
                raise self._source.error(NOT_AFFINE[operator], at)
            if operator == "/" and factor.offset == 0:
                raise self._source.error("this divides by zero", at)
            scaled = result.times(factor.offset) if operator == "*" else result.over(factor.offset)
            result = self._finite(scaled, at)
        return result

    def _call(self, node: Call, path: Path) -> Worth:
        calls: dict[str, Callable[[Call, Path], Worth]] = {
            "abs": self._abs,
            "argmax": self._argmax,
            "clip": self._clip,
            "exp": self._exp,
            "fabs": self._abs,
            "fabsf": self._abs,
            "fmax": self._extreme,
            "fmaxf": self._extreme,
            "fmin": self._extreme,
            "fminf": self._extreme,
            "max": self._extreme,
            "min": self._extreme,
            "tanh": self._tanh,
        }
        return calls[node.function](node, path)

    def _abs(self, node: Call, path: Path) -> Worth:
        worth: Worth = []
        for own, value in self.affine(node.arguments[0], path):
            negative, positive = self._tree.divide(own, value)
            worth += [(negative, value.times(-1.0))] if negative else []
            worth += [(positive, value)] if positive else []
        return worth

    def _argmax(self, node: Call, path: Path) -> Worth:
        """A tournament as in `otr.Argmax`: a tie goes to the first of the arguments."""
        if not self._answers_labels:
            raise self._source.error(
                "argmax answers a label, and this program is read as one that answers values; labels=True reads labels",
                node.at,
            )
        worth: Worth = []
        for start, values in self._several(node.arguments, path):
            champions = [(start, 0)]
            for challenger in range(1, len(values)):
                after: list[tuple[Path, int]] = []
                for own, champion in champions:
                    form = self._finite(values[challenger].minus(values[champion]), node.at)
                    kept, beaten = self._tree.divide(own, form)
                    after += [(kept, champion)] if kept else []
                    after += [(beaten, challenger)] if beaten else []
                champions = after
            worth += [(own, constant(float(champion))) for own, champion in champions]
        return worth

    def _extreme(self, node: Call, path: Path) -> Worth:
        """``max`` and ``min``; one of a function and a constant is a clip, which stays undecided as long as it can."""
        worth = self.value(node.arguments[0], path)
        for argument in node.arguments[1:]:
            worth = [
                result
                for own, best in worth
                for other, value in self.value(argument, own)
                for result in self._better(other, best, value, node)
            ]
        return worth

    def _better(self, path: Path, first: Value, second: Value, node: Call) -> Worth:
        is_max = node.function in ("max", "fmax", "fmaxf")
        if isinstance(first, Affine) and first.is_constant:
            first, second = second, first
        if isinstance(first, Affine | Clipped) and isinstance(second, Affine) and second.is_constant:
            limit = second.offset
            return [(path, clipped(first, low=limit) if is_max else clipped(first, high=limit))]
        worth: Worth = []
        for own, left in self.unclipped(path, first, node.at):
            for other, right in self.unclipped(own, second, node.at):
                below, above = self._tree.divide(other, self._finite(left.minus(right), node.at))
                at_most, at_least = (right, left) if is_max else (left, right)
                worth += [(below, at_most)] if below else []
                worth += [(above, at_least)] if above else []
        return worth

    def _clip(self, node: Call, path: Path) -> Worth:
        inner, low, high = node.arguments
        worth: Worth = []
        for own, limits in self._several((low, high), path):
            (lower, upper), are_constant = limits, all(limit.is_constant for limit in limits)
            if are_constant and lower.offset > upper.offset:
                raise self._source.error(
                    f"clip's limits are {lower.offset:g} and {upper.offset:g}, lower first", node.at
                )
            for other, value in self.value(inner, own):
                if are_constant and isinstance(value, Affine | Clipped):
                    worth.append((other, clipped(value, lower.offset, upper.offset)))
                    continue
                for another, raised in self._better(other, value, lower, Call("max", [], node.at)):
                    worth += self._better(another, raised, upper, Call("min", [], node.at))
        return worth

    def _exp(self, node: Call, path: Path) -> Worth:
        return [(own, Exponential(value)) for own, value in self.affine(node.arguments[0], path)]

    def _tanh(self, node: Call, path: Path) -> Worth:
        return [(own, Squashed(value, 1.0, 0.0)) for own, value in self.affine(node.arguments[0], path)]

    def _finite(self, value: V, at: Place) -> V:
        if not value.is_finite:
            raise self._source.error("the numbers here grow larger than a float64 can hold", at)
        return value


def appended(values: list[T], ends: Sequence[tuple[Path, T]]) -> list[tuple[Path, list[T]]]:
    """Return each of the paths that one has become, with its value after the `values`; take these for a single path."""
    if len(ends) == 1:
        ((path, value),) = ends
        values.append(value)
        return [(path, values)]
    return [(path, [*values, value]) for path, value in ends]
