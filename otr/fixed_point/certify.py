"""Trees in fixed point proved: the search for a certificate, and its check without a search."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from otr.clock import time_limit
from otr.core.arrays import FloatArray, IntArray
from otr.core.domain import Box, Domain, as_domain
from otr.core.fixed_point.tree import FixedPointTree
from otr.core.network import ReluNetwork
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree
from otr.errors import CertificateError
from otr.fixed_point.certificate import PARTS, FixedPointCertificate, digest_of
from otr.fixed_point.leads import ANY_ERROR, LeadChecker, certificate_of_leads
from otr.fixed_point.parts import (
    answer_ranges,
    head_slopes,
    input_roundings,
    leaf_differences,
    output_roundings,
    table_errors,
    test_margins,
    wider_box,
)
from otr.fixed_point.slopes import largest_changes
from otr.proof.certificate import Certificate
from otr.proof.certify import certify
from otr.proof.exact_rows import TreeAndNetwork, rounded_up
from otr.proof.verify import check_fit, verify

Policy = ReluNetwork | PatternTree | ObliqueTree

_FEW_REGIONS = 2**10  # of a leaf
_N_STATES = 2**14  # at which a refusal looks for a claim that fails, and corners of the box


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
        max_error: refuse a larger error of the coefficients, in outputs before the head; the network's regions are
            then searched, which takes long. None takes the bound that few cells give; of labels, of cells that bound it
            about as well as the rounding of inputs allows.
        max_regions, max_seconds: as for `otr.certify`.

    Raises:
        CertificateError: tree and network differ by more; the message names a leaf and a state.
        TreeTooLargeError: a limit was met, of time a TimeLimitError.
        ValueError: the box is open, or the two do not fit each other.

    Examples:
        >>> net = otr.ReluNetwork([[[1.0], [-1.0]], [[1.0, 1.0]]], [[0.0, 0.0], [0.0]], head=otr.ClipBox(0, 1))
        >>> tree = otr.minimal_tree(net, ([-2], [2]))
        >>> fixed = otr.to_fixed_point(tree, ([-2], [2]), bits=8)
        >>> otr.certify_fixed_point(fixed, net, ([-2], [2])).max_error < 0.04
        True
    """
    policy = checked_policy(fixed, network)
    domain = as_domain(box, fixed.n_inputs)
    domain.require_bounded()
    if isinstance(policy, ObliqueTree):
        return _completed(fixed, policy, domain, None)
    wider = wider_box(domain, input_roundings(fixed, domain))
    with time_limit(max_seconds, lambda: "no certificate of the rounded tree was found"):
        allowed = ANY_ERROR if max_error is None else max_error
        if fixed.labels is None:
            inner = certify(fixed.to_tree(), policy, wider, max_error=allowed, max_regions=max_regions)
        else:
            # What the roundings of inputs add in any case is no reason to search for less.
            enough = max_error or float(max(_of_inputs(fixed, policy, domain, wider)))
            n_regions = max_regions if max_error is not None else min(max_regions, _FEW_REGIONS)
            inner = certificate_of_leads(fixed.to_tree(), policy, wider, enough, n_regions)
            if inner.max_error > allowed:
                raise CertificateError(
                    f"the tree's label is proved where the network's lead is above {inner.max_error:.6g}, and "
                    f"max_error is {max_error:.6g}: give more bits or max_regions"
                )
    return _completed(fixed, policy, domain, inner)


def checked_policy(fixed: FixedPointTree, network: Policy) -> ReluNetwork | ObliqueTree:
    """Return the policy that a tree is compared with; one of another kind, size or head is an error."""
    if isinstance(network, PatternTree):
        if network.is_restricted:
            raise ValueError("the PatternTree has only some of its network's paths; give the network or its to_tree()")
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


def _completed(
    fixed: FixedPointTree, policy: ReluNetwork | ObliqueTree, box: Domain, inner: Certificate | None
) -> FixedPointCertificate:
    """Return the certificate with all parts computed, given that of the coefficients."""
    o, gives_labels, margins = fixed.n_outputs, fixed.head.gives_labels, None
    n_compared = 0 if fixed.labels is not None else min(o, 2)  # outputs that a label compares, where tests do not
    if isinstance(policy, ObliqueTree):
        margins = tuple(map(rounded_up, test_margins(fixed, policy, box)))
        coefficients, inputs = leaf_differences(fixed, policy, box)
        if gives_labels:
            coefficients, inputs = ([n_compared * error for error in errors] for errors in (coefficients, inputs))
    else:
        assert inner is not None
        # Of labels that tests decide the certificate's error is a lead.
        coefficients = [Fraction(inner.max_error) * (max(n_compared, 1) if gives_labels else 1)] * o
        inputs = _of_inputs(fixed, policy, box, inner.domain)
    outputs, table, slopes = output_roundings(fixed), table_errors(fixed), head_slopes(fixed)
    if gives_labels:
        parts = [[max(coefficients)], [max(inputs)], [n_compared * max(outputs)], [Fraction(0)]]
    else:
        scaled = ([s * error for s, error in zip(slopes, errors, strict=True)] for errors in (coefficients, inputs))
        parts = [*scaled, outputs, table]
    totals = [sum(values, Fraction(0)) for values in zip(*parts, strict=True)]
    ranges = answer_ranges(fixed.head, o)
    shares = [total / width for total, width in zip(totals, ranges or (), strict=False)]
    return FixedPointCertificate(
        box,
        tuple(map(rounded_up, totals)),
        {name: tuple(map(rounded_up, values)) for name, values in zip(PARTS, parts, strict=True)},
        rounded_up(max(shares)) if shares else None,
        digest_of(fixed),
        inner,
        margins,
    )


def _of_inputs(fixed: FixedPointTree, network: ReluNetwork, box: Domain, wider: Domain) -> list[Fraction]:
    """Return by how much the roundings of inputs change each output or, of labels, each difference of two."""
    differences = _differences(fixed.n_outputs, fixed.head.gives_labels)
    return largest_changes(network, wider, input_roundings(fixed, box), differences)


def _differences(n_outputs: int, gives_labels: bool) -> IntArray:
    """Return the differences of outputs (m, o) that are bounded: each output or, for labels, one less another."""
    eye = np.eye(n_outputs, dtype=np.int64)
    if not gives_labels or n_outputs == 1:
        return eye
    first, second = np.triu_indices(n_outputs, 1)
    return np.asarray(eye[first] - eye[second])


@verify.register
def verify_fixed_point(
    certificate: FixedPointCertificate, tree: FixedPointTree, network: Policy, *, max_seconds: float | None = None
) -> float:
    """Check a certificate of a tree in fixed point, without a solver, and return the bound, `max_error`."""
    policy = checked_policy(tree, network)
    if digest_of(tree) != certificate.digest:
        raise _refused(certificate, tree, policy)
    try:
        return _verified(certificate, tree, policy, max_seconds)
    except (ArithmeticError, IndexError, ValueError) as error:  # of sides, sizes or numbers that are none
        raise CertificateError(f"the certificate does not fit the tree: {error}") from error


def _verified(
    certificate: FixedPointCertificate,
    tree: FixedPointTree,
    policy: ReluNetwork | ObliqueTree,
    max_seconds: float | None,
) -> float:
    box, inner = certificate.box, certificate.certificate
    box.require_bounded()
    if isinstance(policy, ReluNetwork):
        wider = wider_box(box, input_roundings(tree, box))
        if inner is None or (inner.domain.low > wider.low).any() or (inner.domain.high < wider.high).any():
            raise CertificateError("the certificate of the coefficients is missing, or of a smaller box")
        rounded = tree.to_tree()
        if rounded.labels is None:
            verify(inner, rounded, policy, max_seconds=max_seconds)
        else:
            check_fit(inner, rounded, policy)
            LeadChecker(TreeAndNetwork(rounded, policy, inner.domain)).run(inner)
    proved = _completed(tree, policy, box, inner)
    if proved != certificate:
        raise CertificateError(f"the certificate claims {certificate}, and what is proved is {proved}")
    return certificate.max_error


def _refused(
    certificate: FixedPointCertificate, tree: FixedPointTree, policy: ReluNetwork | ObliqueTree
) -> CertificateError:
    """Return the refusal of a changed tree, with the state that contradicts the claim most, if one is found."""
    reason = "the certificate is of another FixedPointTree"
    excess, state = largest_excess(tree, policy, certificate.box, certificate.max_errors, certificate.margins)
    if excess <= 0:
        return CertificateError(f"{reason}; no state was found that contradicts its claim: certify the tree again")
    return CertificateError(
        f"{reason}, and its claim fails at the state {state.tolist()}: the integers answer "
        f"{tree.predict(state).tolist()}, the policy {policy.predict(state).tolist()}, and "
        f"{certificate.max_error:.6g} is claimed",
        state=tuple(map(Fraction, state.tolist())),
    )


def largest_excess(
    tree: FixedPointTree,
    policy: ReluNetwork | ObliqueTree,
    box: Domain,
    max_errors: Sequence[float],
    margins: Sequence[float] | None = None,
) -> tuple[float, FloatArray]:
    """Return by how much an answer is farther from the policy's than is allowed, and where, of some states of a box."""
    rng = np.random.default_rng(0)
    shares = rng.random((_N_STATES, tree.n_inputs))
    states = box.low + np.concatenate((shares, np.rint(shares))) * (box.high - box.low)
    ours, theirs = tree.predict(states), policy.predict(states)
    if tree.head.gives_labels:
        outputs = np.sort(np.column_stack((0 * states[:, : tree.n_outputs == 1], policy.forward(states))), axis=1)
        excess = np.where(ours != theirs, outputs[:, -1] - outputs[:, -2:][:, 0] - max(max_errors), -1.0)
    else:
        excess = (np.abs(ours - theirs) - max_errors).max(axis=1)
    if margins is not None and isinstance(policy, ObliqueTree):
        excess[(np.abs(states @ policy.P.T + policy.v) <= margins).any(axis=1)] = -1.0
    worst = int(excess.argmax())
    return float(excess[worst]), states[worst]
