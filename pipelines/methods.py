"""The methods: each is one row, the stages it takes in order.

The tree of a run is made by one stage: `map` from the trained actor, `imitate` from an oracle, `harden` from a soft
tree. What comes after it is the same for all.
"""

MAPPED = ("train", "map", "prune", "evaluate")
IMITATING = ("oracle", "imitate", "prune", "evaluate")
SOFT = ("train", "harden", "prune", "evaluate")

METHODS: dict[str, tuple[str, ...]] = {
    "otr": MAPPED,
    "linear": MAPPED,
    "pid": MAPPED,
    "viper": IMITATING,
    "lm_viper": IMITATING,
    "augtree": IMITATING,
    "ndps": IMITATING,
    "sdt": SOFT,
    "cdt": SOFT,
    "pi_prl": SOFT,
}


def imitates(method: str) -> bool:
    """Return whether a method imitates an oracle, which is trained first."""
    return METHODS[method] is IMITATING


def is_soft(method: str) -> bool:
    """Return whether a method's actor is a soft tree, which is hardened after training."""
    return METHODS[method] is SOFT


def tree_stage(method: str) -> str:
    """Return the stage that makes a method's tree."""
    return METHODS[method][1]
