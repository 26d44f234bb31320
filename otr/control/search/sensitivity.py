"""How much the actions react to each number of a policy, and noise that is smaller where they react more."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from otr.control.search.policy_numbers import PolicyNumbers
from otr.core.arrays import FloatArray, as_batch
from otr.core.tree import ObliqueTree

STEP = 0.03  # of the differences, in units of a row's size: enough that a few states change the side of a tree's test
MOST_STATES = 1000
MOST_MEDIANS = 3.0  # the largest scale, in medians
ROUNDING = 1e-9  # share of the greatest reaction; what is below may be the rounding of a rewritten policy


def sensitivity_scale(numbers: PolicyNumbers[Any], states: ArrayLike) -> FloatArray:
    """Return the scale of each number's noise (D,), such that all of them together change the actions by about 1.

    The scale of number i is 1 / (sqrt(D) rms |da / dtheta_i|) over the states, actions a in units of half their range
    (safe mutations by rescaling, Lehman et al. 2018); at most three times the median of those that change an action.
    Derivatives are finite differences, so that a tree's tests have one, too.

    Args:
        numbers: of the policy.
        states: (n, d) that it visits; of more than 1,000 as many, evenly spaced.

    Raises:
        ValueError: the actions are labels.
    """
    policy = numbers.policy(numbers.start)
    if policy.head.gives_labels or (isinstance(policy, ObliqueTree) and policy.labels is not None):
        raise ValueError("the actions are labels, which have no derivative; sensitivities are of continuous actions")
    X = as_batch(states, policy.n_inputs)
    X = X[np.linspace(0, len(X) - 1, min(len(X), MOST_STATES)).astype(int)]
    actions = policy.predict(X)
    limits = policy.head.limits(policy.n_outputs)
    sizes = np.ones(actions.shape[1]) if limits is None else (limits[1] - limits[0]) / 2
    sizes = np.where(np.isfinite(sizes) & (sizes > 0), sizes, 1.0)
    reactions = np.zeros_like(numbers.start)
    for i in range(len(reactions)):
        vector = numbers.start.copy()
        vector[i] += STEP
        change = (numbers.policy(vector).predict(X) - actions) / sizes
        reactions[i] = np.sqrt(np.square(change).sum(axis=1).mean()) / STEP
    reacts = reactions > ROUNDING * reactions.max(initial=0.0)
    if not reacts.any():
        return np.ones_like(reactions)
    scale = 1.0 / np.where(reacts, reactions, np.inf) / np.sqrt(len(reactions))
    greatest = MOST_MEDIANS * np.median(scale[reacts])
    return np.asarray(np.where(reacts, np.minimum(scale, greatest), greatest))
