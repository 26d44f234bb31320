"""Certificates of trees in fixed point: how far their answers are from a policy's at every real state of a box.

With x a state, x' = q / t the one that the integers stand for, T the rounded tree and N the network, both before the
head, and F what the integers answer,

    |F(q) - h(N(x))| <= s |T(x') - N(x')| + s |N(x') - N(x)| + |F(q) - h(T(x'))|,

where s is the steepest slope of the head h. The first term is the error of an `otr.Certificate` of T and N on the box
widened by the rounding of inputs; the second is bounded by the network's slopes, as a network is continuous; the third
is the rounding of outputs and the table's error. No term asks whether x and x' are in one leaf.

A tree that jumps is compared test by test and leaf by leaf: as long as no test is within its margin of 0, x and x'
take the same path, and the leaves' maps differ by what is bounded over the box. All is in rational arithmetic, and the
sums are rounded up.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from otr.core.domain import Domain
from otr.core.fixed_point.tree import FixedPointTree
from otr.errors import ArtefactError
from otr.proof.certificate import Certificate

SCHEMA = "otr/fixed-point-certificate/1"
PARTS = ("coefficients", "inputs", "outputs", "table")


@dataclass(frozen=True, repr=False)
class FixedPointCertificate:
    """The proof of how far the answers of a `FixedPointTree`, scaled back, are from a policy's on a box.

    At every real state x of the box, and its integers q by `FixedPointTree.to_integers`, answer k differs from the
    policy's by at most ``max_errors[k]``. Of labels it is the policy's lead: the label is the same wherever the output
    of the policy's label is above every other by more than ``max_errors[0]``, or, of Sign, is that far from 0.

    Of a policy that is a tree, which jumps, this holds of states at which every test on its path is farther from 0 than
    its margin: ``|P[i] @ x + v[i]| > margins[i]``. Of its labels it then holds without a lead.

    Attributes:
        box: where.
        max_errors: (o,), of labels (1,); sums of the parts, rounded up.
        parts: by name, what coefficients, inputs, outputs and the table of tanh add: (o,) or (1,) each.
        share: the largest error as a share of its action's range; None where an action has no limits.
        digest: of the FixedPointTree.
        certificate: of its rounded coefficients, for a network.
        margins: (n_nodes,), for a tree.
    """

    box: Domain
    max_errors: tuple[float, ...]
    parts: dict[str, tuple[float, ...]]
    share: float | None
    digest: str
    certificate: Certificate | None = None
    margins: tuple[float, ...] | None = None

    @property
    def max_error(self) -> float:
        """The largest of `max_errors`."""
        return max(self.max_errors)

    def __repr__(self) -> str:
        parts = ", ".join(f"{name} {max(values):.3g}" for name, values in self.parts.items() if any(values))
        share = "" if self.share is None else f", {self.share:.3%} of the range"
        return f"FixedPointCertificate(max_error={self.max_error:.3g}{share}: {parts or 'exact'})"

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            "schema": SCHEMA,
            "box": self.box.to_dict(),
            "max_errors": list(self.max_errors),
            "parts": {name: list(values) for name, values in self.parts.items()},
            "share": self.share,
            "digest": self.digest,
            "margins": None if self.margins is None else list(self.margins),
            "certificate": None if self.certificate is None else self.certificate.to_dict(),
        }

    @classmethod
    def from_dict(cls, description: dict[str, Any]) -> FixedPointCertificate:
        """Return what `to_dict` described.

        Raises:
            ArtefactError: something is missing.
        """
        try:
            inner, margins, share = (description[name] for name in ("certificate", "margins", "share"))
            return cls(
                Domain.from_dict(description["box"]),
                tuple(map(float, description["max_errors"])),
                {name: tuple(map(float, description["parts"][name])) for name in PARTS},
                None if share is None else float(share),
                str(description["digest"]),
                None if inner is None else Certificate.from_dict(inner),
                None if margins is None else tuple(map(float, margins)),
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ArtefactError(f"the certificate cannot be read: {error!r}; certify the tree again") from error

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the certificate as JSON, which `otr.load_certificate` reads."""
        target = Path(path)
        target.write_text(json.dumps(self.to_dict()) + "\n")
        return target


def digest_of(fixed: FixedPointTree) -> str:
    """Return the SHA-256 of all numbers that decide a tree's answers."""
    arrays = (fixed.children_left, fixed.children_right, fixed.P, fixed.v, fixed.M, fixed.c, fixed.shifts)
    held: list[Any] = [array.tolist() for array in (*arrays, fixed.input_low, fixed.input_high)]
    held += [str(scale) for scale in (*fixed.input_scales, *fixed.output_scales)]
    held += [fixed.bits, fixed.accumulator_bits, fixed.head.to_dict()]
    held.append(None if fixed.labels is None else fixed.labels.tolist())
    table = fixed.table
    held.append(None if table is None else [table.values.tolist(), table.unit_bits, table.step_bits])
    return hashlib.sha256(json.dumps(held, sort_keys=True).encode()).hexdigest()
