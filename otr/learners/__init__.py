"""Trees learned from data, under scikit-learn's contract; each learner's `tree_` is an `otr.ObliqueTree`.

A learner's module, and with it scikit-learn or torch, is loaded when the learner is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_MODULES = {
    "AugTreeClassifier": "augtree",
    "AugTreeRegressor": "augtree",
    "CARTClassifier": "cart",
    "CARTRegressor": "cart",
    "HHCARTClassifier": "hhcart",
    "HHCARTRegressor": "hhcart",
    "LCNClassifier": "lcn",
    "LCNRegressor": "lcn",
    "LinearModelTreeRegressor": "model_tree",
    "LinearTreeClassifier": "linear",
    "LinearTreeRegressor": "linear",
    "OTRClassifier": "otr_trees",
    "OTRRegressor": "otr_trees",
    "TAOClassifier": "tao",
    "from_sklearn_tree": "cart",
}

__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(_MODULES)}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
