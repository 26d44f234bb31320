"""Oblique trees from ReLU networks: map a policy to a tree that computes the same function, prune it, write it out.

>>> import otr
>>> net = otr.ReluNetwork([[[-2.7, -0.8], [0.2, 2.0], [1.0, -0.1]], [[-2.0, -2.4, 1.2]]], [[-0.4, 0.6, 1.2], [1.4]])
>>> tree = otr.map_network(net)
>>> tree
ObliqueTree(n_leaves=8, depth=3, n_inputs=2, n_outputs=1, head=Identity())
>>> tree.predict([0.5, -0.5]).round(9)
array([3.5])
"""

from otr.core.domain import Domain
from otr.core.head import Argmax, ClipBox, Head, Identity, PidBox, Sign, TanhBox, head_from_dict
from otr.core.io import load, save
from otr.core.mapping import map_network
from otr.core.network import ReluNetwork
from otr.core.pattern_tree import PatternTree
from otr.core.pruning import prune_to_k, prune_unreached
from otr.core.tree import ObliqueTree
from otr.errors import (
    ArtefactError,
    CertificateError,
    InvalidNetworkError,
    InvalidTreeError,
    OtrError,
    ProgramError,
    TreeTooLargeError,
)
from otr.geometry.minimal_tree import minimal_tree
from otr.importers import from_sb3, from_sklearn, from_torch
from otr.importers.vec_normalize import ObservationStatistics
from otr.programs import (
    draw_tree,
    parse_program,
    save_picture,
    to_c,
    to_dot,
    to_json,
    to_latex,
    to_onnx,
    to_python,
    to_structured_text,
    to_text,
)
from otr.proof.certificate import Certificate, load_certificate
from otr.proof.certify import certify
from otr.proof.properties import Condition, check_verdict, find_violation, output_range, reachable_labels
from otr.proof.verify import verify
from otr.shorten.refit_tests import refit_tests
from otr.shorten.simplify import simplify, within

__version__ = "0.1.0"

__all__ = [
    "Argmax",
    "ArtefactError",
    "Certificate",
    "CertificateError",
    "ClipBox",
    "Condition",
    "Domain",
    "Head",
    "Identity",
    "InvalidNetworkError",
    "InvalidTreeError",
    "ObliqueTree",
    "ObservationStatistics",
    "OtrError",
    "PatternTree",
    "PidBox",
    "ProgramError",
    "ReluNetwork",
    "Sign",
    "TanhBox",
    "TreeTooLargeError",
    "certify",
    "check_verdict",
    "draw_tree",
    "find_violation",
    "from_sb3",
    "from_sklearn",
    "from_torch",
    "head_from_dict",
    "load",
    "load_certificate",
    "map_network",
    "minimal_tree",
    "output_range",
    "parse_program",
    "prune_to_k",
    "prune_unreached",
    "reachable_labels",
    "refit_tests",
    "save",
    "save_picture",
    "simplify",
    "to_c",
    "to_dot",
    "to_json",
    "to_latex",
    "to_onnx",
    "to_python",
    "to_structured_text",
    "to_text",
    "verify",
    "within",
]
