"""The methods: each is one row, the stages it takes in order.

The tree of a run is made by one stage: `map` from the trained actor, `imitate` from an oracle, `harden` from a soft
tree, `parse` from a program. What comes after it is the same for all.
"""

MAPPED = ("train", "map", "prune", "evaluate")
IMITATING = ("oracle", "imitate", "prune", "evaluate")
SOFT = ("train", "harden", "prune", "evaluate")
WRITTEN = ("parse", "prune", "evaluate")
EXTRAS = ("certify", "simplify")  # after all others, where certify=true or simplify=true asks for them

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
    "program": WRITTEN,
}


def imitates(method: str) -> bool:
    """Return whether a method imitates an oracle, which is trained first."""
    return METHODS[method] is IMITATING


def is_soft(method: str) -> bool:
    """Return whether a method's actor is a soft tree, which is hardened after training."""
    return METHODS[method] is SOFT


def is_written(method: str) -> bool:
    """Return whether a method's policy is a program that somebody wrote, so that nothing is trained."""
    return METHODS[method] is WRITTEN


def is_mapped(method: str) -> bool:
    """Return whether a method's tree is a trained network's, which it can be proved equal to."""
    return METHODS[method] is MAPPED


def tree_stage(method: str) -> str:
    """Return the stage that makes a method's tree: the one before it is pruned."""
    stages = METHODS[method]
    return stages[stages.index("prune") - 1]
