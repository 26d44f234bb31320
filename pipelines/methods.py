"""The methods: each is one row, the stages it takes in order."""

METHODS: dict[str, tuple[str, ...]] = {
    "otr": ("train", "map", "prune", "evaluate"),
    "linear": ("train", "map", "prune", "evaluate"),
}
