"""Trees learned from data, under scikit-learn's contract; each learner's `tree_` is an `otr.ObliqueTree`.

A learner's module, and with it scikit-learn or torch, is loaded when the learner is first used.
"""

from __future__ import annotations

from otr.extras import lazy_exports

_MODULES = {
    "AugTreeClassifier": "augtree",
    "AugTreeRegressor": "augtree",
    "CARTClassifier": "cart",
    "CARTRegressor": "cart",
    "HHCARTClassifier": "hhcart",
    "HHCARTRegressor": "hhcart",
    "LCNClassifier": "lcn",
    "LCNRegressor": "lcn",
    "LinearTreeClassifier": "linear",
    "LinearTreeRegressor": "model_tree",
    "OTRClassifier": "otr",
    "OTRRegressor": "otr",
    "TAOClassifier": "tao",
    "from_sklearn_tree": "cart",
}

__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
