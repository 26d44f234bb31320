"""The random numbers of a fleet: a generator for each run, drawn some steps ahead, so that no run disturbs another."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

DRAWS_AHEAD = 32  # steps of environments: enough to make the calls cheap, little enough to stay in the cache


@dataclass
class Draws:
    """Random numbers for N vector steps of R runs with E environments, and U updates of B transitions among them."""

    policy: Tensor  # (R, N, E, n_actions), standard normal, of the stochastic policy
    exploration: Tensor  # (R, N, E, n_actions), standard normal, added to actions after scaling
    actions: Tensor  # (R, N, E, n_actions), uniform in [-1, 1), before learning starts
    updates: Tensor  # (R, U, 2 B, n_actions), standard normal, of an update's actions
    fractions: Tensor  # (R, U, B), uniform in [0, 1), float64, choose an update's transitions


class Streams:
    """The generators of R runs, one a seed; what run r draws depends on its own seed alone (E, B as in `Draws`)."""

    def __init__(self, seeds: Sequence[int], n_envs: int, batch_size: int, n_actions: int) -> None:
        self._generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        self._n_envs, self._batch_size, self._n_actions = n_envs, batch_size, n_actions
        self.n_steps_ahead = max(1, DRAWS_AHEAD // n_envs)

    def draw(self, n_updates: int) -> Draws:
        """Return the numbers for the next `n_steps_ahead` vector steps and `n_updates` updates."""
        n, e, b, a = self.n_steps_ahead, self._n_envs, self._batch_size, self._n_actions

        def each(method: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            whole = torch.empty(len(self._generators), *shape, dtype=dtype)
            for part, generator in zip(whole, self._generators, strict=True):
                getattr(part, method)(generator=generator)
            return whole

        return Draws(
            policy=each("normal_", n, e, a),
            exploration=each("normal_", n, e, a),
            actions=each("uniform_", n, e, a).mul_(2).sub_(1),
            updates=each("normal_", n_updates, 2 * b, a),
            fractions=each("uniform_", n_updates, b, dtype=torch.float64),
        )
