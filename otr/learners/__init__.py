"""Trees learned from data, under scikit-learn's contract; each learner's `tree_` is an `otr.ObliqueTree`.

Classes are imported when they are first asked for, so that importing this package costs nothing.
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
    "LinearModelTreeRegressor": "model_tree",
    "TAOClassifier": "tao",
    "from_sklearn_tree": "cart",
}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
