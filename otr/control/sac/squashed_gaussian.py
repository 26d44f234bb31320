"""Actions of the soft actor-critic: normal ones squashed by tanh or clipped, their log-probabilities and derivatives.

As in Stable-Baselines3: log-probabilities are corrected for tanh by log(1 - tanh(u)^2 + 1e-6), and log standard
deviations are clipped to [-20, 2].
"""

import math

import torch
from torch import Tensor

from otr.control.sac.stacked_tensors import new_stack

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
SQUASH_EPSILON = 1e-6
HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


class SquashedActions:
    """The workspace for the actions of R runs in `n_rows` states each; `actions` is what `sample` returned last."""

    def __init__(self, n_runs: int, n_rows: int, n_actions: int) -> None:
        # Functions like tanh are computed in our stacks: elsewhere their bits would depend on the address.
        self._std, self.actions, self._slope, self._log_slope = (new_stack(n_runs, n_rows, n_actions) for _ in range(4))
        self._n_actions = n_actions

    def sample(self, answers: Tensor, noise: Tensor | None) -> Tensor:
        """Return actions in [-1, 1], (R, n_rows, n_actions); they are overwritten by the next ones.

        Args:
            answers: (R, n_rows, 2 n_actions), the actor's: means, then log standard deviations.
            noise: (R, n_rows, n_actions), standard normal; None for the deterministic action.
        """
        return self._drawn(answers, noise, self.actions).tanh_()

    def _drawn(self, answers: Tensor, noise: Tensor | None, out: Tensor) -> Tensor:
        """Write the normal samples, before they are squashed or clipped, into `out`."""
        mean, log_std = answers.chunk(2, dim=2)
        if noise is None:
            return out.copy_(mean)
        torch.clamp(log_std, LOG_STD_MIN, LOG_STD_MAX, out=self._std).exp_()
        return torch.mul(self._std, noise, out=out).add_(mean)

    def log_probability(self, answers: Tensor, noise: Tensor) -> Tensor:
        """Return log pi of what `sample` just returned for the same answers and noise, (R, n_rows)."""
        torch.mul(self.actions, self.actions, out=self._slope)
        torch.sub(1, self._slope, out=self._slope)  # of tanh
        terms = noise * noise * -0.5
        terms -= answers[:, :, self._n_actions :].clamp(LOG_STD_MIN, LOG_STD_MAX)
        terms -= torch.add(self._slope, SQUASH_EPSILON, out=self._log_slope).log_()
        return terms.sum(2).sub_(self._n_actions * HALF_LOG_2PI)

    def gradient(self, answers: Tensor, noise: Tensor, temperature: Tensor, d_actions: Tensor, out: Tensor) -> None:
        """Write mean(temperature * log pi - value)'s derivative by the answers in the first B rows into `out`.

        Args:
            answers, noise: as given to `sample` and `log_probability` just before.
            temperature: (R, 1).
            d_actions: (R, B, n_actions), the derivative of the mean's second term by the actions.
            out: (R, B, 2 n_actions).
        """
        n_rows, n_actions = out.shape[1], self._n_actions
        actions, slope, std, noise = (tensor[:, :n_rows] for tensor in (self.actions, self._slope, self._std, noise))
        share = (temperature / n_rows).unsqueeze(2)  # of one transition's entropy in the mean
        d_mean, d_log_std = out.chunk(2, dim=2)
        torch.mul(actions / (slope + SQUASH_EPSILON), 2 * share, out=d_mean)
        d_mean += d_actions
        d_mean *= slope
        torch.mul(d_mean, std * noise, out=d_log_std)
        d_log_std -= share
        raw = answers[:, :n_rows, n_actions:]
        d_log_std *= (raw >= LOG_STD_MIN) & (raw <= LOG_STD_MAX)


class ClippedActions(SquashedActions):
    """The same for actions clipped to [-1, 1]; log-probabilities are those of the normal ones before the clip.

    Beyond the box a mean only learns inwards: the critic does not see what a clip removes.
    """

    def sample(self, answers: Tensor, noise: Tensor | None) -> Tensor:
        return torch.clamp(self._drawn(answers, noise, self._slope), -1.0, 1.0, out=self.actions)

    def log_probability(self, answers: Tensor, noise: Tensor) -> Tensor:
        terms = noise * noise * -0.5
        terms -= answers[:, :, self._n_actions :].clamp(LOG_STD_MIN, LOG_STD_MAX)
        return terms.sum(2).sub_(self._n_actions * HALF_LOG_2PI)

    def gradient(self, answers: Tensor, noise: Tensor, temperature: Tensor, d_actions: Tensor, out: Tensor) -> None:
        n_rows, n_actions = out.shape[1], self._n_actions
        unclipped, std, noise = (tensor[:, :n_rows] for tensor in (self._slope, self._std, noise))
        d_mean, d_log_std = out.chunk(2, dim=2)
        torch.mul(d_actions, (unclipped.abs() <= 1.0) | (unclipped * d_actions > 0.0), out=d_mean)
        torch.mul(d_mean, std * noise, out=d_log_std)
        d_log_std -= (temperature / n_rows).unsqueeze(2)
        raw = answers[:, :n_rows, n_actions:]
        d_log_std *= (raw >= LOG_STD_MIN) & (raw <= LOG_STD_MAX)
