"""Fixed point of given words, or of the shortest for which a proof is found."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from otr.core.domain import Box, Domain, as_domain
from otr.core.fixed_point.tree import FixedPointTree
from otr.core.heads import Identity
from otr.core.network import ReluNetwork
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree, require_tree
from otr.errors import CertificateError, InvalidTreeError
from otr.fixed_point.certificate import FixedPointCertificate
from otr.fixed_point.certify import Policy, certify_fixed_point, checked_policy, largest_excess
from otr.fixed_point.parts import answer_ranges
from otr.fixed_point.rounding import Scales, round_tree
from otr.proof.properties import output_range

_LEAST_BITS, _MOST_BITS = 4, 24


def to_fixed_point(
    tree: ObliqueTree | PatternTree,
    box: Domain | Box,
    bits: int | None = 16,
    *,
    input_scales: Scales | None = None,
    output_scales: Scales | None = None,
    accumulator_bits: int = 32,
    max_error: float | None = None,
    network: Policy | None = None,
) -> FixedPointTree:
    """Return a tree that computes in integers, whose sums are proved not to overflow whatever the inputs are.

    Every row is multiplied by the largest number with which it fits its word and its sum the accumulator, and rounded.

    Args:
        tree: the tree; its head Identity, ClipBox, TanhBox, Argmax or Sign.
        box: the states, bounded; inputs beyond are clamped to its sides.
        bits: of coefficients, inputs and outputs, 2 to 24; None for the fewest, from 4 on, with which `max_error` is
            proved of `network`.
        input_scales: what 1 of each input stands for (d,), of a sensor or converter; default: the largest |x| of the
            box over the largest integer of a word, for each input one with which errors are small, of 2 to `bits` bits.
        output_scales: what 1 of each answer stands for (o,); default: the same of the action's range or, of TanhBox,
            half the range over the word.
        accumulator_bits: 32 or 64.
        max_error: only without `bits`, as a share of each action's range: of its limits or, of outputs and labels, of
            what the tree's output takes over the box; see `FixedPointCertificate.max_errors`.
        network: the policy that `max_error` is about; default: the tree itself, but near its tests.

    Raises:
        InvalidTreeError: a row does not fit; the message names it and both numbers.
        CertificateError: no words are long enough for `max_error`.
        ValueError: the box is open, or an argument is out of range.

    Examples:
        >>> tree = otr.parse_program("if x <= 0.5: -x else: 2 x", ["x"])
        >>> fixed = otr.to_fixed_point(tree, ([-1], [1]), bits=8, input_scales=[1 / 64])
        >>> fixed.predict_integers([[-32], [48]]), fixed.predict([-0.5])
        (array([[16],
               [48]]), array([0.5]))
    """
    given: dict[str, Any] = {"input_scales": input_scales, "output_scales": output_scales}
    given["accumulator_bits"] = accumulator_bits
    if bits is not None:
        if max_error is not None or network is not None:
            raise ValueError("max_error and network choose the bits: give bits=None, or leave them out")
        return round_tree(tree, box, bits, **given)
    return shortest_fixed_point(tree, network, box, 0.01 if max_error is None else max_error, **given)[0]


def shortest_fixed_point(
    tree: ObliqueTree | PatternTree,
    network: Policy | None,
    box: Domain | Box,
    max_error: float = 0.01,
    **settings: Any,
) -> tuple[FixedPointTree, FixedPointCertificate]:
    """Return the tree of the shortest words for which an error is proved, and the proof; see `to_fixed_point`.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]], head=otr.ClipBox(0, 1))
        >>> tree = otr.minimal_tree(net, ([-2], [2]))
        >>> fixed, proof = otr.shortest_fixed_point(tree, net, ([-2], [2]), max_error=0.01)
        >>> fixed.bits, proof.share < 0.01
        (10, True)
    """
    tree = tree.to_tree() if isinstance(tree, PatternTree) else tree
    require_tree(tree)
    domain = as_domain(box, tree.n_inputs)
    reason: object = "rounding alone is more"
    for bits in range(_LEAST_BITS, _MOST_BITS + 1):
        try:
            fixed = round_tree(tree, domain, bits, **settings)
        except InvalidTreeError as error:
            reason = error
            continue
        policy = checked_policy(fixed, tree if network is None else network)
        allowed = [max_error * width for width in _widths(fixed, tree, domain)]
        if isinstance(policy, ReluNetwork) and largest_excess(fixed, policy, domain, list(map(float, allowed)))[0] > 0:
            reason = f"with {bits} bits an answer is off by more"
            continue
        proof = certify_fixed_point(fixed, policy, domain)
        if all(error <= most for error, most in zip(proof.max_errors, allowed, strict=True)):
            return fixed, proof
        reason = f"with {bits} bits it is {proof}"
    raise CertificateError(f"no words of {_LEAST_BITS} to {_MOST_BITS} bits are proved to {max_error:g}: {reason}")


def _widths(fixed: FixedPointTree, tree: ObliqueTree, domain: Domain) -> list[Fraction]:
    """Return what errors are shares of: the actions' ranges, or those of the outputs; of labels the widest alone."""
    ranges = answer_ranges(fixed.head, fixed.n_outputs)
    if ranges is not None:
        return ranges
    taken = output_range(tree.replace(labels=None, head=Identity()), domain)
    widths = [Fraction(width) for width in (taken.high - taken.low).tolist()]
    return [max(widths)] if fixed.head.gives_labels else widths
