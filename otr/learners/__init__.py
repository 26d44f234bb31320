"""Trees from data, in scikit-learn's manner; a learner's module, and with it torch, is loaded when it is asked for."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_MODULES = {
    "LCNClassifier": "lcn",
    "LCNRegressor": "lcn",
    "LinearTreeClassifier": "linear",
    "LinearTreeRegressor": "linear",
    "OTRClassifier": "otr_trees",
    "OTRRegressor": "otr_trees",
}

__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(_MODULES)}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_MODULES)
