"""Conditions on a policy's actions as text, and the answer: proved, a state where it fails, or what is undecided."""

import math
from dataclasses import dataclass
from decimal import ROUND_CEILING, Context

import numpy as np

import otr
from otr.geometry.regions import leaf_paths
from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.spaces import action_names, feature_names

BEFORE = "if "  # of a condition, which makes it a program
LARGEST_ACTION = 1e6  # of policies whose actions have no limits, where it is asked whether any policy keeps a condition
ACTION = "action"  # what conditions call the label of a policy that answers labels


@dataclass(frozen=True)
class Answer:
    """What was found: `holds` is None where there is neither a proof nor a state where it fails."""

    holds: bool | None
    text: str


@dataclass(frozen=True)
class Row:
    """A comparison that holds, with others, where a condition fails: state @ x + action @ u + offset <= 0, or > 0."""

    state: np.ndarray
    action: np.ndarray
    offset: float
    is_above: bool


def always(tree: otr.ObliqueTree, condition: str, env: EnvConfig, domain: otr.Domain) -> Answer:
    """Return whether a condition, over an environment's names as in programs, holds in every state of a box.

    Where it fails, several comparisons hold together, one set of them for each way that it can fail. A way is ruled out
    by `otr.find_violation` where one of its comparisons of actions holds nowhere, given those of the state alone. A
    state that is found counts where the policy's own answer fails the condition; else the way stays undecided.

    Raises:
        ConfigError: the condition cannot be read; shows the place.
        ValueError: the box is unbounded, or the policy's head multiplies outputs.
    """
    features = feature_names(env, tree.n_inputs)
    actions = action_names(env, tree.n_answers)
    undecided = []
    for label in [None] if tree.labels is None else otr.reachable_labels(tree, domain).tolist():
        failing = _read(condition, features, actions, label)
        for rows in _ways_to_fail(failing, len(features), 0 if label is not None else len(actions)):
            verdicts = [otr.find_violation(tree, each, domain) for each in _questions(tree, rows, label)]
            if any(verdict.holds for verdict in verdicts):
                continue
            states = [verdict.state for verdict in verdicts if verdict.state is not None]
            state = next((state for state in states if _fails(failing, tree, state, label)), None)
            if state is not None:
                place = in_words(features, state)
                return Answer(False, f"fails: {condition}, at {place}, with {answer_in_words(tree, state, actions)}")
            undecided.append(" and ".join(_comparison(row, [*features, *actions]) for row in rows))
    if undecided:
        return Answer(None, f"undecided: {condition}; neither a state nor a proof was found where "
                      + ", or ".join(undecided))  # fmt: skip
    return Answer(True, f"proved: {condition}{_vacuity(tree, condition, features, actions, domain)}")


def _vacuity(tree: otr.ObliqueTree, condition: str, features: list[str], actions: list[str], domain: otr.Domain) -> str:
    """Return that a condition is vacuous, as every policy keeps it; nothing where it is not.

    Every policy is any with the same labels, or with actions within the same limits, or a million without any.
    """
    labels = [None] if tree.labels is None else range(len(actions))
    limits = None if tree.labels is not None else tree.head.limits(tree.n_outputs)
    n_free = 0 if tree.labels is not None else len(actions)
    low, high = limits or (np.full(n_free, -LARGEST_ACTION), np.full(n_free, LARGEST_ACTION))
    both = otr.Domain(np.append(domain.low, low[:n_free]), np.append(domain.high, high[:n_free]))
    anything = otr.ObliqueTree([], [], np.zeros((0, both.n_inputs)), [], np.zeros((1, 1, both.n_inputs)), [[0.0]])
    for label in labels:
        for rows in _ways_to_fail(_read(condition, features, actions, label), len(features), n_free):
            given = tuple(otr.HalfSpace(np.append(row.state, row.action), row.offset, row.is_above) for row in rows)
            nowhere = otr.Condition(np.zeros(both.n_inputs), np.zeros(1), -1.0, given)
            if not otr.find_violation(anything, nowhere, both).holds:
                return ""
    return (
        "\nThat says nothing about the policy: no state of the box can fail the condition, whatever the action is. It "
        "is the condition and the box that exclude it"
    )


def ranges(tree: otr.ObliqueTree, env: EnvConfig, domain: otr.Domain) -> list[str]:
    """Return a line for every action: its smallest and largest value on a box; of labels, which are reached."""
    names = action_names(env, tree.n_answers)
    if tree.labels is not None:
        reached = otr.reachable_labels(tree, domain).tolist()
        never = [name for label, name in enumerate(names) if label not in reached]
        return [
            f"reached: {', '.join(names[label] for label in reached)}",
            f"never: {', '.join(never) or 'none of them'}",
        ]
    found = otr.output_range(tree, domain)
    return [f"{name}: {low:.6g} to {high:.6g}" for name, low, high in zip(names, found.low, found.high, strict=True)]


def _read(condition: str, features: list[str], actions: list[str], label: int | None) -> otr.ObliqueTree:
    """Return the tree that answers 1 where a condition holds and 0 where it fails, over states and actions.

    With a label, which the condition knows by the name `action`, over states alone.
    """
    if not condition.strip():
        raise ConfigError("always=: which condition? Such as always='torque >= 0', in the names of the environment")
    given = "" if label is None else f"{ACTION} = {label}\n"
    names = features if label is not None else [*features, *actions]
    try:
        return otr.parse_program(
            f"{given}{BEFORE}{condition} then 1 else 0",
            names,
            output_names=actions if label is not None and len(actions) > 1 else None,
            labels=True,
        )
    except otr.ProgramError as error:
        column = max(1, error.column - len(BEFORE))
        raise ConfigError(f"always: {error.reason}\n    {condition}\n    {' ' * (column - 1)}^") from error


def _ways_to_fail(failing: otr.ObliqueTree, d: int, n_actions: int) -> list[list[Row]]:
    """Return the comparisons on the path to each leaf at which a condition fails."""
    nodes, signs = leaf_paths(failing)
    assert failing.labels is not None
    ways = []
    for leaf in np.flatnonzero(failing.labels == 0).tolist():
        path = [
            (node, sign) for node, sign in zip(nodes[leaf].tolist(), signs[leaf].tolist(), strict=True) if node >= 0
        ]
        rows = [(failing.P[node], float(failing.v[node]), sign > 0) for node, sign in path]
        ways.append([Row(P[:d], P[d : d + n_actions], v, is_above) for P, v, is_above in rows])
    return ways


def _questions(tree: otr.ObliqueTree, rows: list[Row], label: int | None) -> list[otr.Condition]:
    """Return conditions each of which, where it always holds, rules out that a policy gets to all these comparisons."""
    given = tuple(otr.HalfSpace(row.state, row.offset, row.is_above) for row in rows if not row.action.any())
    none, idle = np.zeros(tree.n_inputs), np.zeros(tree.n_outputs)
    if label is not None:
        weights = tree.head.weights_of_label(label, tree.n_outputs)
        # Of a sign head label 0 weighs 0, and is reached where 1 is not.
        return [otr.Condition(none, weights if weights.any() else weights - 1.0, 0.0 if weights.any() else -1.0, given)]
    asked = []
    for row in rows:
        if row.action.any() and row.is_above:
            asked.append(otr.Condition(row.state, row.action, -row.offset, given))
        elif row.action.any():  # at 0, too, it is no longer ruled out
            strict = float(np.nextafter(row.offset, -math.inf))
            asked.append(otr.Condition(-row.state, -row.action, strict, given))
    return asked or [otr.Condition(none, idle, -1.0, given)]  # which fails wherever there is a state


def _fails(failing: otr.ObliqueTree, tree: otr.ObliqueTree, state: np.ndarray, label: int | None) -> bool:
    """Return whether the policy's own answer to a state fails the condition."""
    answer = tree.predict(state)
    if label is not None:
        return int(answer) == label and int(failing.predict(state)) == 0
    return int(failing.predict(np.concatenate((state, np.atleast_1d(answer))))) == 0


def answer_in_words(policy: otr.ObliqueTree | otr.ReluNetwork, state: np.ndarray, actions: list[str]) -> str:
    """Return a policy's own answer to a state (d,): a label's name, or every action's value."""
    answer = policy.predict(state)
    if policy.head.gives_labels:
        return f"{ACTION} = {actions[int(answer)]}"
    return in_words(actions, np.atleast_1d(answer))


def in_words(names: list[str], values: np.ndarray) -> str:
    """Return values with their names."""
    return ", ".join(f"{name} = {value}" for name, value in zip(names, values.tolist(), strict=True))


def _comparison(row: Row, names: list[str]) -> str:
    weights = [*row.state.tolist(), *row.action.tolist()]
    terms = [f"{weight:+.6g} {name}" for weight, name in zip(weights, names, strict=False) if weight]
    return f"{' '.join([*terms, f'{row.offset:+.6g}'])} {'>' if row.is_above else '<='} 0"


def number_of(n: int, what: str) -> str:
    """Return how many there are: 1 leaf, 1,024 leaves."""
    plural = {"leaf": "leaves"}.get(what, f"{what}s")
    return f"{n:,} {what if n == 1 else plural}"


def labels_but(bound: float) -> str:
    """Return where labels that are proved the same may still differ, of `otr.Certificate.max_error`, as text."""
    return "on a boundary between two" if bound < np.finfo(float).tiny else f"within {bound_text(bound)} of a boundary"


def bound_text(bound: float, digits: int = 1) -> str:
    """Return a bound as text with so many digits, rounded up from its shortest decimal form."""
    return str(
        Context(prec=digits, rounding=ROUND_CEILING).create_decimal(repr(float(bound)).removesuffix(".0"))
    ).lower()
