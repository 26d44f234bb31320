"""A finished policy as the actor of the soft actor-critic, and the oracle whose critics judge it."""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from otr.control.search.state_moments import scale_of
from otr.control.soft_trees.policy_module import policy_module
from otr.core.head import Head
from otr.core.heads import ClipBox, Identity, TanhBox
from otr.core.network import ReluNetwork
from otr.core.smooth_network import Layered
from otr.core.tree import ObliqueTree
from otr.importers.critics import Critics

LOG_STD_LIMITS = (-5.0, 2.0)  # of the deviations that a policy begins with
FIRST_LOG_STD = -1.5  # where no oracle defines how far to explore


class PolicyActor(nn.Module):
    """From states (n, d) to means and log standard deviations (n, 2 n_actions), in the units of critics.

    Means are the policy's outputs, of clipped ones in units of half their box. Log standard deviations are linear in
    the state; they only serve learning and are no part of the policy.
    """

    _low: Tensor
    _high: Tensor
    _mean: Tensor
    _scale: Tensor

    def __init__(
        self,
        policy: ObliqueTree | ReluNetwork,
        states: np.ndarray,
        log_stds: np.ndarray | None,
        *,
        free: bool,
        tied: bool = False,
    ) -> None:
        """Take a policy's numbers.

        Args:
            policy: squashed into a box of actions, or clipped to it.
            states: (n, d) float, visited; their moments are the units of its inputs.
            log_stds: (n, n_actions), the initial deviations in these states; None for a constant.
            free: whether coefficients that are zero learn, too.
            tied: whether a tree's tests that are equal, and its leaves that are, stay equal.
        """
        super().__init__()
        limits = policy.head.limits(policy.n_outputs)
        assert limits is not None
        self.policy = policy_module(policy, states, free=free, tied=tied)
        self._is_clipped = is_clipped(policy.head)
        mean, scale = states.mean(axis=0), scale_of(states.mean(axis=0), states.std(axis=0))
        for name, values in (("_low", limits[0]), ("_high", limits[1]), ("_mean", mean), ("_scale", scale)):
            self.register_buffer(name, torch.tensor(values, dtype=torch.get_default_dtype()), persistent=False)
        self.log_std = nn.Linear(policy.n_inputs, len(limits[0]))
        with torch.no_grad():
            self.log_std.weight.zero_()
            self.log_std.bias.fill_(FIRST_LOG_STD)
            if log_stds is not None:
                standardised = np.column_stack(((states - mean) / scale, np.ones(len(states))))
                fitted = np.linalg.lstsq(standardised, np.clip(log_stds, *LOG_STD_LIMITS), rcond=None)[0]
                self.log_std.weight.copy_(torch.from_numpy(fitted[:-1].T))
                self.log_std.bias.copy_(torch.from_numpy(fitted[-1]))

    def forward(self, states: Tensor) -> Tensor:
        means = self.policy(states)
        if self._is_clipped:
            means = (2 * means - self._low - self._high) / (self._high - self._low)
        return torch.cat((means, self.log_std((states - self._mean) / self._scale)), dim=1)


def is_clipped(head: Head) -> bool:
    """Return whether a head clips its outputs to the box of actions; else tanh leads them there."""
    return isinstance(head, ClipBox)


def check_critics(critics: Critics, policy: Any) -> None:
    """Raise TypeError where no critics improve such actions, ValueError where they judge other states or actions."""
    head, n_read = policy.head, critics.layers[0][0].shape[1]
    if not isinstance(head, ClipBox | TanhBox):
        name = type(head).__name__
        raise TypeError(f"critics improve actions that tanh or a clip leads into their box, not {name}; use a search")
    if n_read != policy.n_inputs + policy.n_outputs:
        expected = f"{policy.n_inputs} of a state and {policy.n_outputs} of an action"
        raise ValueError(f"the critics read {n_read} numbers, expected {expected}; give the imitated policy's critics")


class OraclePlay:
    """An oracle's stochastic policy, as it explored while it was trained."""

    def __init__(self, oracle: Layered, critics: Critics) -> None:
        """Take the actor, and its deviations from its critics; without these its actions have no noise of their own."""
        weights, biases = list(oracle.weights), list(oracle.biases)
        self._n_actions, self._has_deviations = len(biases[-1]), critics.log_std is not None
        if critics.log_std is not None:
            if critics.log_std.shape[1] - 1 != weights[-1].shape[1]:
                read = f"reads {critics.log_std.shape[1] - 1} numbers, not {weights[-1].shape[1]}"
                raise ValueError(f"the critics are of an actor whose last layer {read}; give the imitated policy's")
            weights[-1] = np.concatenate((weights[-1], critics.log_std[:, :-1]))
            biases[-1] = np.concatenate((biases[-1], critics.log_std[:, -1]))
        self._network: Any = oracle.replace(weights=weights, biases=biases, head=Identity())

    def log_stds(self, states: np.ndarray) -> np.ndarray | None:
        """Return the log standard deviations in states (n, d), (n, n_actions); None for an oracle without."""
        found: np.ndarray = self._network.forward(states)[:, self._n_actions :]
        return found if self._has_deviations else None

    def act(self, states: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return actions in [-1, 1], (n, n_actions), for standard normal noise of this shape."""
        outputs = self._network.forward(states)
        means, log_stds = outputs[:, : self._n_actions], outputs[:, self._n_actions :]
        if self._has_deviations:
            means = means + noise * np.exp(np.clip(log_stds, -20.0, 2.0))
        acted: np.ndarray = np.tanh(means)
        return acted
