"""Oblique trees from ReLU networks: map a policy to a tree that computes the same function, prune it, write it out.

>>> import otr
>>> net = otr.ReluNetwork([[[-2.7, -0.8], [0.2, 2.0], [1.0, -0.1]], [[-2.0, -2.4, 1.2]]], [[-0.4, 0.6, 1.2], [1.4]])
>>> tree = otr.map_network(net)
>>> tree
ObliqueTree(n_leaves=8, depth=3, n_inputs=2, n_outputs=1, head=Identity())
>>> tree.predict([0.5, -0.5]).round(9)
array([3.5])
"""

from otr.errors import ArtefactError, InvalidNetworkError, InvalidTreeError, OtrError, TreeTooLargeError
from otr.head import Argmax, ClipBox, Head, Identity, PidBox, Sign, TanhBox, head_from_dict
from otr.importers import from_sb3, from_sklearn, from_torch
from otr.io import load, save
from otr.mapping import map_network
from otr.network import ReluNetwork
from otr.pattern_tree import PatternTree
from otr.programs import draw_tree, save_picture, to_text
from otr.pruning import prune_to_k, prune_unreached
from otr.simplify import refit_tests
from otr.tree import ObliqueTree

__version__ = "0.1.0"

__all__ = [
    "Argmax",
    "ArtefactError",
    "ClipBox",
    "Head",
    "Identity",
    "InvalidNetworkError",
    "InvalidTreeError",
    "ObliqueTree",
    "OtrError",
    "PatternTree",
    "PidBox",
    "ReluNetwork",
    "Sign",
    "TanhBox",
    "TreeTooLargeError",
    "draw_tree",
    "from_sb3",
    "from_sklearn",
    "from_torch",
    "head_from_dict",
    "load",
    "map_network",
    "prune_to_k",
    "prune_unreached",
    "refit_tests",
    "save",
    "save_picture",
    "to_text",
]
