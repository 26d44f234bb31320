"""PID policies: gains in the leaves of an oblique tree (Orfanos 2023, section 4.1.1, Fig. 4.3 and 4.4).

With the state s (d,), the goal e and the history h of the k states before s, oldest first,

    P = e - s        I = sum_i (e - h_i)        D = h_k - s        u = theta_P . P + theta_I . I + theta_D . D

A small ReLU network gives the gains, theta = theta(s). What acts is a policy of the *observation* [s, P, I, D] (4 d,),
because the terms need the past: `pid_network` writes it as one `ReluNetwork` whose outputs are the terms and the gains
and whose head, `otr.PidBox`, multiplies them. Both are piecewise affine in the observation, so mapping, pruning and
certificates hold for the policy unchanged: its tree tests s, and a leaf's gains are affine in s. The action is not
affine in a leaf; with `constant_gains` it is (before the tanh), at the price of being another policy.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from otr.core.arrays import FloatArray, as_batch
from otr.core.heads import PidBox, TanhBox
from otr.core.network import ReluNetwork
from otr.core.tree import ObliqueTree
from otr.errors import InvalidNetworkError, InvalidTreeError

TERMS = PidBox.terms


def pid_observation(state: ArrayLike, history: ArrayLike, goal: ArrayLike) -> FloatArray:
    """Return [s, P, I, D] of one state (Orfanos 2023, section 4.1.1).

    Args:
        state: s, (d,), in the environment's units.
        history: (k, d), the states before s, oldest first; at an episode's start the first state k times.
        goal: e, (d,), where the system is to come to rest.

    Returns:
        (4 d,): the state, P = e - s, I = sum_i (e - h_i), D = h_k - s.

    Raises:
        ValueError: the shapes do not agree.
    """
    s, h, e = (np.asarray(values, dtype=np.float64) for values in (state, history, goal))
    if s.ndim != 1 or e.shape != s.shape or h.ndim != 2 or h.shape[1:] != s.shape or len(h) == 0:
        raise ValueError(
            f"state, history and goal have shapes {s.shape}, {h.shape} and {e.shape}, expected (d,), (k, d) and (d,)"
        )
    return np.concatenate((s, e - s, (e - h).sum(axis=0), h[-1] - s))


def pid_observation_names(feature_names: Sequence[str]) -> list[str]:
    """Return the names of an observation's 4 d components: the state's own, then P_<name>, I_<name>, D_<name>."""
    return [*feature_names, *(f"{term}_{name}" for term in TERMS for name in feature_names)]


def pid_network(gains: ReluNetwork, low: ArrayLike, high: ArrayLike) -> ReluNetwork:
    """Return the policy of observations [s, P, I, D] whose gains a network of s gives.

    Args:
        gains: from s (d,) to the gains of the a actions, (a * 3 d,): those of P, of I, of D, action by action.
        low, high: (a,) limits of the action box.

    Returns:
        Network of 4 d inputs and 3 d (1 + a) outputs, [phi, theta_1, ..., theta_a], with the head `PidBox` and as many
        hidden neurons as `gains` has; the terms also reach the outputs directly (dense="input").

    Raises:
        InvalidNetworkError: `gains` has links past its layers, or another number of outputs.
    """
    d, head = gains.n_inputs, PidBox(low, high)
    n_actions, n_terms = len(head.low), len(TERMS) * d
    if gains.n_outputs != n_actions * n_terms:
        raise InvalidNetworkError(
            f"the gains' network has {gains.n_outputs} outputs, expected {n_actions * n_terms}: one for each of the "
            f"{n_terms} terms of {d} inputs and each of {n_actions} actions"
        )
    if gains.dense is not False:
        raise InvalidNetworkError(f"the gains' network has dense={gains.dense!r}, expected plain layers")
    # Every layer but the first reads [activations, s, P, I, D]; the first, [s, P, I, D].
    weights = [
        np.concatenate((W, np.zeros((len(W), n_terms if layer == 0 else d + n_terms))), axis=1)
        for layer, W in enumerate(gains.weights)
    ]
    terms = np.zeros((n_terms, weights[-1].shape[1]))
    terms[:, -n_terms:] = np.eye(n_terms)
    weights[-1] = np.concatenate((terms, weights[-1]))
    biases = [*gains.biases[:-1], np.concatenate((np.zeros(n_terms), gains.biases[-1]))]
    return ReluNetwork(
        weights,
        biases,
        negative_slope=gains.negative_slope,
        dense="input" if gains.n_hidden else False,
        head=head,
    )


def constant_gains(tree: ObliqueTree, X: ArrayLike) -> ObliqueTree:
    """Return the tree whose gains are constant in each leaf: their mean over the observations that reach it.

    That is the common PID program, `u = theta_P . P + theta_I . I + theta_D . D` with numbers for theta, and it has
    affine leaves; it is another policy than `tree` unless the gains are constant already.

    Args:
        tree: a tree with the head `PidBox`.
        X: (n, 4 d) observations of its rollouts, at least one in each leaf.

    Returns:
        Tree with the same tests, the head `TanhBox` and one output an action.

    Raises:
        InvalidTreeError: another head, or a leaf that no observation reaches.
    """
    if not isinstance(tree.head, PidBox):
        raise InvalidTreeError(f"the tree's head is {tree.head!r}, expected a PidBox: gains in the leaves")
    observations = as_batch(X, tree.n_inputs)
    leaves = tree.apply(observations)
    counts = np.bincount(leaves, minlength=tree.n_leaves)
    if not counts.all():
        empty = np.flatnonzero(counts == 0).tolist()
        raise InvalidTreeError(f"no observation reaches leaf {empty[0]} of {tree.n_leaves}; prune_unreached first")
    means = np.stack([observations[leaves == leaf].mean(axis=0) for leaf in range(tree.n_leaves)])
    n_actions = len(tree.head.low)
    n_terms = tree.head.n_terms(tree.n_outputs)
    outputs = np.einsum("lod,ld->lo", tree.M, means) + tree.c
    theta = outputs[:, n_terms:].reshape(tree.n_leaves, n_actions, n_terms)
    M = np.einsum("lam,lmd->lad", theta, tree.M[:, :n_terms])
    c = np.einsum("lam,lm->la", theta, tree.c[:, :n_terms])
    head = TanhBox(tree.head.low, tree.head.high)
    return tree.replace(M=M, c=c, head=head)
