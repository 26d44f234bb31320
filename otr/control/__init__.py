"""Trees from interaction: imitation of an oracle under DAgger, and soft trees trained by policy gradient.

A module, and with it scikit-learn or torch, is loaded when one of its names is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_MODULES = {
    "AugTreeFit": "augtree",
    "CartFit": "viper",
    "CascadingTree": "cdt",
    "DaggerResult": "dagger.loop",
    "DaggerSettings": "dagger.loop",
    "Iterate": "dagger.loop",
    "LinearModelTreeFit": "viper",
    "NdpsImitator": "ndps",
    "NdpsSettings": "ndps",
    "Progress": "dagger.loop",
    "RelaxedProgram": "pi_prl",
    "SoftTree": "soft_tree",
    "argmax_leaves": "label_leaves",
    "constant_gains": "pid",
    "draw_rows": "dagger.row_sampling",
    "fit_ndps": "ndps",
    "pid_network": "pid",
    "pid_observation": "pid",
    "pid_observation_names": "pid",
    "run_dagger": "dagger.loop",
}

__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(_MODULES)}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
