"""Trees in fixed point proved: the search for a certificate, and its check without a search."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from otr.clock import time_limit
from otr.core.domain import Box, Domain, as_domain
from otr.core.fixed_point_tree import FixedPointTree
from otr.core.network import ReluNetwork
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree
from otr.errors import CertificateError
from otr.fixed_point.certificate import PARTS, FixedPointCertificate, differences_of, digest_of
from otr.fixed_point.parts import (
    answer_ranges,
    head_slopes,
    input_roundings,
    output_roundings,
    table_errors,
    wider_box,
)
from otr.fixed_point.pieces import bound_of, certificate_by_pieces
from otr.fixed_point.slopes import largest_changes
from otr.fixed_point.states import probing_states
from otr.fixed_point.tree_margins import leaf_differences, test_margins
from otr.proof.certificate import Certificate
from otr.proof.certify import certify
from otr.proof.exact_rows import rounded_up
from otr.proof.verify import verify

Policy = ReluNetwork | PatternTree | ObliqueTree
Parts = dict[str, list[Fraction]]


def certify_fixed_point(
    fixed: FixedPointTree,
    network: Policy,
    box: Domain | Box,
    *,
    max_error: float | None = None,
    max_regions: int = 2**16,
    max_seconds: float | None = None,
) -> FixedPointCertificate:
    """Return a proof of how far the answers of a tree in fixed point are from a policy's, at every state of a box.

    Args:
        fixed: the tree.
        network: the policy; a tree must be the one that was rounded, and is compared except near its tests.
        box: bounded.
        max_error: refuse a larger error of the coefficients, in outputs before the head; where a bound leaf by leaf is
            larger, `otr.certify` searches the network's regions, which takes long. None keeps that bound.
        max_regions, max_seconds: as for `otr.certify`.

    Raises:
        CertificateError: tree and network differ by more; the message names a leaf and a state.
        TreeTooLargeError: a limit was met, of time a TimeLimitError.
        ValueError: the box is open, or the two do not fit each other.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]], head=otr.ClipBox(0, 1))
        >>> tree = otr.minimal_tree(net, ([-2], [2]))
        >>> fixed = otr.to_fixed_point(tree, ([-2], [2]), bits=8)
        >>> otr.certify_fixed_point(fixed, net, ([-2], [2])).max_error < 0.02
        True
    """
    policy = checked_policy(fixed, network)
    domain = as_domain(box, fixed.n_inputs)
    domain.require_bounded()
    if isinstance(policy, ObliqueTree):
        return _completed(fixed, policy, domain, None)
    wider = wider_box(domain, input_roundings(fixed, domain))
    with time_limit(max_seconds, lambda: "no certificate of the rounded tree was found"):
        inner = _certificate(fixed.to_tree(), policy, wider, max_error, max_regions)
    return _completed(fixed, policy, domain, inner)


def checked_policy(fixed: FixedPointTree, network: Policy) -> ReluNetwork | ObliqueTree:
    if isinstance(network, PatternTree):
        if network.is_restricted:
            raise ValueError(
                "the PatternTree has some of its network's paths alone; give the network, or its to_tree()"
            )
        network = network.network
    if not isinstance(fixed, FixedPointTree) or not isinstance(network, ReluNetwork | ObliqueTree):
        raise TypeError(
            "certify_fixed_point takes a FixedPointTree and a ReluNetwork, a PatternTree or an ObliqueTree, got "
            f"{type(fixed).__name__} and {type(network).__name__}"
        )
    ours, theirs = ((each.n_inputs, each.n_outputs, each.head) for each in (fixed, network))
    if ours != theirs:
        raise ValueError(f"the tree has (inputs, outputs, head) {ours}, the policy {theirs}; they must be the same")
    return network


def _certificate(
    tree: ObliqueTree, network: ReluNetwork, box: Domain, max_error: float | None, max_regions: int
) -> Certificate:
    """Return the certificate of the rounded coefficients, by pieces or, if that does not do, by a search."""
    found = certificate_by_pieces(tree, network, box)
    if max_error is None or found.max_error <= max_error:
        return found
    if tree.labels is not None:
        raise CertificateError(
            f"the tree's label is proved where the network's lead is above {found.max_error:.6g}, and max_error is "
            f"{max_error:.6g}: give more bits"
        )
    return certify(tree, network, box, max_error=max_error, max_regions=max_regions)


def _completed(
    fixed: FixedPointTree, policy: ReluNetwork | ObliqueTree, box: Domain, inner: Certificate | None
) -> FixedPointCertificate:
    """Return the certificate with all parts computed, given that of the coefficients."""
    margins = None
    if isinstance(policy, ObliqueTree):
        margins = tuple(map(rounded_up, test_margins(fixed, policy, box)))
        parts = _parts_of_tree(fixed, policy, box)
    else:
        assert inner is not None
        parts = _parts_of_network(fixed, policy, box, inner.domain, Fraction(inner.max_error))
    totals = [sum(values, Fraction(0)) for values in zip(*parts.values(), strict=True)]
    ranges, share = answer_ranges(fixed), None
    if ranges is not None:
        share = rounded_up(max(total / width for total, width in zip(totals, ranges, strict=True)))
    return FixedPointCertificate(
        box,
        tuple(map(rounded_up, totals)),
        {name: tuple(map(rounded_up, parts[name])) for name in PARTS},
        share,
        digest_of(fixed),
        inner,
        margins,
    )


def _parts_of_network(
    fixed: FixedPointTree, network: ReluNetwork, box: Domain, wider: Domain, error: Fraction
) -> Parts:
    """Return the parts, given the error of the coefficients on the box widened by the rounding of inputs."""
    roundings = input_roundings(fixed, box)
    differences = differences_of(fixed.n_outputs, gives_labels=fixed.head.gives_labels)
    changes = largest_changes(network, wider, roundings, differences)
    if fixed.labels is not None:  # the certificate's error is a lead
        return _of_labels(error, max(changes), Fraction(0))
    outputs = output_roundings(fixed)
    if fixed.head.gives_labels:
        return _of_labels(error * _sides(fixed), max(changes), max(outputs) * _sides(fixed))
    slopes = head_slopes(fixed)
    return {
        "coefficients": [slope * error for slope in slopes],
        "inputs": [slope * change for slope, change in zip(slopes, changes, strict=True)],
        "outputs": outputs,
        "table": table_errors(fixed),
    }


def allowed_error(fixed: FixedPointTree, network: ReluNetwork, box: Domain, budgets: Sequence[Fraction]) -> Fraction:
    """Return the largest error of the coefficients with which all answers' errors are within budgets (o,) or (1,)."""
    wider = wider_box(box, input_roundings(fixed, box))
    without, with_one = (
        [
            sum(each, Fraction(0))
            for each in zip(*_parts_of_network(fixed, network, box, wider, error).values(), strict=True)
        ]
        for error in (Fraction(0), Fraction(1))
    )
    allowed = (
        (budget - fewer) / (more - fewer)
        for budget, fewer, more in zip(budgets, without, with_one, strict=True)
        if more > fewer
    )
    return min(allowed, default=Fraction(0))


def _parts_of_tree(fixed: FixedPointTree, tree: ObliqueTree, box: Domain) -> Parts:
    if fixed.labels is not None:
        return _of_labels(Fraction(0), Fraction(0), Fraction(0))
    coefficients, inputs = leaf_differences(fixed, tree, box)
    outputs = output_roundings(fixed)
    if fixed.head.gives_labels:
        return _of_labels(*(max(each) * _sides(fixed) for each in (coefficients, inputs, outputs)))
    slopes = head_slopes(fixed)
    return {
        "coefficients": [slope * error for slope, error in zip(slopes, coefficients, strict=True)],
        "inputs": [slope * error for slope, error in zip(slopes, inputs, strict=True)],
        "outputs": outputs,
        "table": table_errors(fixed),
    }


def _sides(fixed: FixedPointTree) -> int:
    """Return how many outputs a label compares: of Argmax two, of Sign one."""
    return min(fixed.n_outputs, 2)


def _of_labels(coefficients: Fraction, inputs: Fraction, outputs: Fraction) -> Parts:
    return {"coefficients": [coefficients], "inputs": [inputs], "outputs": [outputs], "table": [Fraction(0)]}


@verify.register
def verify_fixed_point(
    certificate: FixedPointCertificate,
    tree: FixedPointTree,
    network: Policy,
    *,
    max_seconds: float | None = None,
) -> float:
    """Check a certificate of a tree in fixed point, without a solver, and return the bound, `max_error`."""
    policy, box = checked_policy(tree, network), certificate.box
    if digest_of(tree) != certificate.digest:
        raise _refused("the certificate is of another FixedPointTree", certificate, tree, policy)
    inner = certificate.certificate
    if isinstance(policy, ReluNetwork):
        wider = wider_box(box, input_roundings(tree, box))
        if inner is None or (inner.domain.low > wider.low).any() or (inner.domain.high < wider.high).any():
            raise CertificateError("the certificate of the coefficients is missing, or of a smaller box")
        if bound_of(inner, tree.to_tree(), policy, max_seconds=max_seconds) > inner.max_error:
            raise CertificateError("the certificate of the coefficients claims a smaller error than it proves")
    proved = _completed(tree, policy, box, inner)
    _require(certificate.max_errors, proved.max_errors, "errors")
    _require(certificate.margins or (), proved.margins or (), "margins")
    return certificate.max_error


def _require(claimed: Sequence[float], proved: Sequence[float], what: str) -> None:
    if len(claimed) != len(proved) or any(ours < theirs for ours, theirs in zip(claimed, proved, strict=True)):
        raise CertificateError(f"the certificate claims the {what} {claimed}, and proved are {proved}")


def _refused(
    reason: str, certificate: FixedPointCertificate, tree: FixedPointTree, policy: ReluNetwork | ObliqueTree
) -> CertificateError:
    """Return the refusal of a certificate, with the state that contradicts its claim most, if one is found."""
    states = probing_states(tree.to_tree(), certificate.box)
    ours, theirs = tree.predict(states), policy.predict(states)
    if tree.head.gives_labels:
        Y = policy.forward(states) if tree.n_outputs > 1 else np.pad(policy.forward(states), ((0, 0), (1, 0)))
        lead = np.sort(Y, axis=1)[:, -1] - np.sort(Y, axis=1)[:, -2]
        excess = np.where(ours != theirs, lead - certificate.max_error, -1.0)
    else:
        excess = (np.abs(ours - theirs) - certificate.max_errors).max(axis=1)
    if certificate.margins is not None and isinstance(policy, ObliqueTree):
        values = np.abs(states @ policy.P.T + policy.v)
        excess[(values <= np.array(certificate.margins)).any(axis=1)] = -1.0
    worst = int(excess.argmax())
    if excess[worst] <= 0:
        return CertificateError(f"{reason}; no state was found that contradicts its claim: certify the tree again")
    state = states[worst]
    return CertificateError(
        f"{reason}, and its claim fails at the state {state.tolist()}: the integers answer "
        f"{np.asarray(ours[worst]).tolist()}, the policy {np.asarray(theirs[worst]).tolist()}, and "
        f"{certificate.max_error:.6g} is claimed",
        state=tuple(map(Fraction, state.tolist())),
    )
