"""Oblique trees from ReLU networks: map a policy to a tree that computes the same function, prune it, write it out.

>>> import otr
>>> net = otr.ReluNetwork([[[-2.7, -0.8], [0.2, 2.0], [1.0, -0.1]], [[-2.0, -2.4, 1.2]]], [[-0.4, 0.6, 1.2], [1.4]])
>>> tree = otr.map_network(net)
>>> tree
ObliqueTree(n_leaves=8, depth=3, n_inputs=2, n_outputs=1, head=Identity())
>>> tree.predict([0.5, -0.5]).round(9)
array([3.5])

A module is imported when one of its names is first used.
"""

from typing import TYPE_CHECKING

from otr.extras import lazy_exports

# The alias says to type checkers that the name is public.
# isort: off
if TYPE_CHECKING:
    from otr import control as control, importers as importers, learners as learners
    from otr.control.imitate import imitate as imitate
    from otr.control.rollout import Rollout as Rollout, evaluate as evaluate, rollout as rollout
    from otr.control.search.polish import polish as polish
    from otr.control.settings import SearchSettings as SearchSettings
    from otr.core.domain import Domain as Domain
    from otr.core.fixed_point.tree import FixedPointTree as FixedPointTree
    from otr.core.head import Head as Head
    from otr.core.heads import (
        Argmax as Argmax,
        ClipBox as ClipBox,
        Exp as Exp,
        Identity as Identity,
        PidBox as PidBox,
        Sign as Sign,
        TanhBox as TanhBox,
        head_from_dict as head_from_dict,
    )
    from otr.files.artefacts import load as load, save as save
    from otr.core.mapping import map_network as map_network
    from otr.core.network import ReluNetwork as ReluNetwork
    from otr.core.pattern_tree import PatternTree as PatternTree
    from otr.core.pruning import prune_to_k as prune_to_k, prune_unreached as prune_unreached, tree as tree
    from otr.core.tree import ObliqueTree as ObliqueTree
    from otr.errors import (
        ArtefactError as ArtefactError,
        CertificateError as CertificateError,
        InvalidNetworkError as InvalidNetworkError,
        InvalidTreeError as InvalidTreeError,
        MissingExtraError as MissingExtraError,
        OtrError as OtrError,
        ProgramError as ProgramError,
        TimeLimitError as TimeLimitError,
        TreeTooLargeError as TreeTooLargeError,
    )
    from otr.explanation.explain import explain as explain
    from otr.explanation.importance import importance as importance
    from otr.fixed_point.certificate import FixedPointCertificate as FixedPointCertificate
    from otr.fixed_point.certify import certify_fixed_point as certify_fixed_point
    from otr.fixed_point.shortest import shortest_fixed_point as shortest_fixed_point, to_fixed_point as to_fixed_point
    from otr.geometry.minimal_tree import minimal_tree as minimal_tree
    from otr.importers import (
        from_onnx as from_onnx,
        from_sb3 as from_sb3,
        from_sklearn as from_sklearn,
        from_torch as from_torch,
        read_policy as read_policy,
    )
    from otr.importers.critics import Critics as Critics, read_critics as read_critics
    from otr.importers.hub import from_hub as from_hub
    from otr.importers.input_statistics import ObservationStatistics as ObservationStatistics
    from otr.programs.c.float_error import FloatErrorBound as FloatErrorBound, float_error as float_error
    from otr.programs.c.source import to_c as to_c
    from otr.programs.dot import to_dot as to_dot
    from otr.programs.json import to_json as to_json
    from otr.programs.latex import to_latex as to_latex
    from otr.programs.onnx import to_onnx as to_onnx
    from otr.programs.parser import parse_program as parse_program
    from otr.programs.picture.drawing import draw_tree as draw_tree, save_picture as save_picture
    from otr.programs.picture.svg import to_svg as to_svg
    from otr.programs.python import to_python as to_python
    from otr.programs.structured_text import to_structured_text as to_structured_text
    from otr.programs.text import to_text as to_text
    from otr.proof.certificate import Certificate as Certificate, load_certificate as load_certificate
    from otr.proof.certify import certify as certify
    from otr.proof.difference import find_difference as find_difference
    from otr.proof.properties import (
        check_verdict as check_verdict,
        find_violation as find_violation,
        output_range as output_range,
        reachable_labels as reachable_labels,
    )
    from otr.proof.verdict import Condition as Condition, HalfSpace as HalfSpace
    from otr.proof.verify import verify as verify
    from otr.shorten.refit_tests import refit_tests as refit_tests
    from otr.shorten.simplify import simplify as simplify, within as within
# isort: on

__version__ = "0.1.0"

_NAMES_OF_MODULES = {
    "control.imitate": "imitate",
    "control.rollout": "Rollout evaluate rollout",
    "control.search.polish": "polish",
    "control.settings": "SearchSettings",
    "core.domain": "Domain",
    "core.fixed_point.tree": "FixedPointTree",
    "core.head": "Head",
    "core.heads": "Argmax ClipBox Exp Identity PidBox Sign TanhBox head_from_dict",
    "files.artefacts": "load save",
    "core.mapping": "map_network",
    "core.network": "ReluNetwork",
    "core.pattern_tree": "PatternTree",
    "core.pruning": "prune_to_k prune_unreached tree",
    "core.tree": "ObliqueTree",
    "errors": "ArtefactError CertificateError InvalidNetworkError InvalidTreeError MissingExtraError OtrError "
    "ProgramError TimeLimitError TreeTooLargeError",
    "explanation.explain": "explain",
    "explanation.importance": "importance",
    "fixed_point.certificate": "FixedPointCertificate",
    "fixed_point.certify": "certify_fixed_point",
    "fixed_point.shortest": "shortest_fixed_point to_fixed_point",
    "geometry.minimal_tree": "minimal_tree",
    "importers": "from_onnx from_sb3 from_sklearn from_torch read_policy",
    "importers.critics": "Critics read_critics",
    "importers.hub": "from_hub",
    "importers.input_statistics": "ObservationStatistics",
    "programs.c.float_error": "FloatErrorBound float_error",
    "programs.c.source": "to_c",
    "programs.dot": "to_dot",
    "programs.json": "to_json",
    "programs.latex": "to_latex",
    "programs.onnx": "to_onnx",
    "programs.parser": "parse_program",
    "programs.picture.drawing": "draw_tree save_picture",
    "programs.picture.svg": "to_svg",
    "programs.python": "to_python",
    "programs.structured_text": "to_structured_text",
    "programs.text": "to_text",
    "proof.certificate": "Certificate load_certificate",
    "proof.certify": "certify",
    "proof.difference": "find_difference",
    "proof.properties": "check_verdict find_violation output_range reachable_labels",
    "proof.verdict": "Condition HalfSpace",
    "proof.verify": "verify",
    "shorten.refit_tests": "refit_tests",
    "shorten.simplify": "simplify within",
}
_MODULES = {name: module for module, names in _NAMES_OF_MODULES.items() for name in names.split()}
_SUBPACKAGES = ("control", "importers", "learners")  # those with names of their own, as otr.learners.OTRClassifier

__all__ = sorted(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES, _SUBPACKAGES)
