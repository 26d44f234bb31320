"""Oblique trees from ReLU networks: map a policy to a tree that computes the same function, prune it, write it out.

>>> import otr
>>> net = otr.ReluNetwork([[[-2.7, -0.8], [0.2, 2.0], [1.0, -0.1]], [[-2.0, -2.4, 1.2]]], [[-0.4, 0.6, 1.2], [1.4]])
>>> tree = otr.map_network(net)
>>> tree
ObliqueTree(n_leaves=8, depth=3, n_inputs=2, n_outputs=1, head=Identity())
>>> tree.predict([0.5, -0.5]).round(9)
array([3.5])
"""

from otr.certificate import Certificate, load_certificate
from otr.domain import Domain
from otr.errors import (
    ArtefactError,
    CertificateError,
    InvalidNetworkError,
    InvalidTreeError,
    OtrError,
    ProgramError,
    TreeTooLargeError,
)
from otr.head import Argmax, ClipBox, Head, Identity, PidBox, Sign, TanhBox, head_from_dict
from otr.importers import from_sb3, from_sklearn, from_torch
from otr.io import load, save
from otr.mapping import map_network
from otr.minimal import minimal_tree
from otr.network import ReluNetwork
from otr.pattern_tree import PatternTree
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
from otr.properties import Condition, check_verdict, find_violation, output_range, reachable_labels
from otr.proving import certify
from otr.pruning import prune_to_k, prune_unreached
from otr.refit import refit_tests
from otr.simplify import simplify, within
from otr.tree import ObliqueTree
from otr.vec_normalize import ObservationStatistics
from otr.verification import verify

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
