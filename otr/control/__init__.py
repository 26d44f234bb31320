"""Trees from interaction: imitation of an oracle under DAgger, and soft trees trained by policy gradient.

A module, and with it scikit-learn or torch, is loaded when one of its names is first used.
"""

from __future__ import annotations

from otr.extras import lazy_exports

_MODULES = {
    "AugTreeFit": "augtree",
    "CartFit": "viper",
    "CascadingTree": "soft_trees.cascading_tree",
    "DaggerProgress": "dagger.loop",
    "DaggerResult": "dagger.loop",
    "DaggerSettings": "settings",
    "ExpertsFit": "experts",
    "Iterate": "dagger.loop",
    "LinearExperts": "experts",
    "LinearModelTreeFit": "viper",
    "NdpsImitator": "ndps",
    "NdpsSettings": "settings",
    "RelaxedProgram": "soft_trees.relaxed_program",
    "SoftTree": "soft_trees.soft_tree",
    "StudentFit": "distilled_otr",
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
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
