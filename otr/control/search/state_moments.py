"""Mean and standard deviation of all states seen so far, batch after batch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from otr.core.arrays import FloatArray

CONSTANT = 1e-8  # a component that varies less than that, relative to its size, is a constant


def scale_of(mean: FloatArray, std: FloatArray) -> FloatArray:
    """Return what components of this mean and standard deviation (d,) are divided by: 1 for constants, else `std`."""
    return np.where(std > CONSTANT * np.maximum(1.0, np.abs(mean)), std, 1.0)


class StateMoments:
    """Running mean and variance of d components (Chan, Golub & LeVeque 1983).

    Attributes:
        n: states seen.
        mean: (d,), zeros before the first.
        squares: (d,), the sum of the squared differences from the mean.
    """

    def __init__(self, d: int) -> None:
        self.n, self.mean, self.squares = 0, np.zeros(d), np.zeros(d)

    def add(self, states: FloatArray) -> None:
        """Add states (n, d)."""
        if not len(states):
            return
        mean = states.mean(axis=0)
        total = self.n + len(states)
        change = mean - self.mean
        self.squares += np.square(states - mean).sum(axis=0) + np.square(change) * (self.n * len(states) / total)
        self.mean = self.mean + change * (len(states) / total)
        self.n = total

    @property
    def scale(self) -> FloatArray:
        """The standard deviation (d,); 1 for constants, and for all before two states were seen."""
        return scale_of(self.mean, np.sqrt(self.squares / max(self.n, 1)))

    def state(self) -> dict[str, FloatArray]:
        """Return n, mean and squares as arrays by name."""
        return {"n": np.array(float(self.n)), "mean": self.mean, "squares": self.squares}

    def restore(self, state: Mapping[str, FloatArray]) -> None:
        """Resume from what `state` returned."""
        self.n, self.mean, self.squares = int(state["n"]), np.array(state["mean"]), np.array(state["squares"])
