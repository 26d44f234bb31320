"""Augmented random search (Mania, Guy & Recht 2018): a vector is improved by trying its neighbours, in pairs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from otr.control.settings import SearchSettings
from otr.core.arrays import FloatArray
from otr.setting import check_settings


class DirectSearch:
    """A search for the vector of the greatest return, an iteration at a time: `ask`, play what it gives, `tell`.

    With r_i+ and r_i- the returns of theta + nu delta_i and theta - nu delta_i, for normal directions delta_i:

        theta += alpha / (b sigma) * sum over i of (r_i+ - r_i-) delta_i

    over the b directions with the greatest max(r_i+, r_i-); sigma is the standard deviation of their 2b returns. With
    momentum mu the step is the weighted mean ``velocity = mu * velocity + (1 - mu) * step`` of the steps so far.

    A scale for each number multiplies its part of all directions, and so noise and step alike.

    The directions of an iteration depend on the seed and its number alone, so `centre`, `velocity` and `n_iterations`
    are the whole state.

    Attributes:
        settings: as given.
        centre: (D,) float64, where the search is.
        velocity: (D,), the weighted mean of the steps.
        n_iterations: the number of calls of `tell`.
    """

    def __init__(self, centre: ArrayLike, settings: SearchSettings, seed: int, scale: ArrayLike = 1.0) -> None:
        """Begin at `centre` (D,), with a scale for each number (D,) or one for all.

        Raises:
            ValueError: the settings make no search.
        """
        check_settings(settings)
        self.settings = settings
        self.centre: FloatArray = np.array(centre, dtype=np.float64)
        self.velocity: FloatArray = np.zeros_like(self.centre)
        self.n_iterations = 0
        self._seed, self._scale = seed, np.asarray(scale, dtype=np.float64)
        self._step_size = settings.step_size

    def ask(self, done: float = 0.0) -> FloatArray:
        """Return the vectors to try (2 n_directions, D): rows 2i and 2i + 1 are direction i, forwards and backwards.

        Args:
            done: share of the search that is done, from 0 to 1, by which step and noise fall.
        """
        settings = self.settings
        self._step_size = settings.step_size * _fallen(settings.step_size_end, done)
        away = settings.noise * _fallen(settings.noise_end, done) * self._directions()
        return np.stack((self.centre + away, self.centre - away), axis=1).reshape(-1, len(self.centre))

    def tell(self, returns: ArrayLike) -> None:
        """Make the step that the returns (2 n_directions,) of those vectors suggest; none if all are equal."""
        pairs = np.asarray(returns, dtype=np.float64).reshape(self.settings.n_directions, 2)
        top = np.argsort(-pairs.max(axis=1), kind="stable")[: self.settings.n_top]
        spread = pairs[top].std()
        step = np.zeros_like(self.centre)
        if spread > 0:
            slopes = (pairs[top, 0] - pairs[top, 1]) / (self.settings.n_top * spread)
            step = self._step_size * (slopes @ self._directions()[top])
        self.velocity = self.settings.momentum * self.velocity + (1 - self.settings.momentum) * step
        self.centre = self.centre + self.velocity
        self.n_iterations += 1

    def state(self) -> dict[str, FloatArray]:
        """Return the state from which a search resumes, as arrays by name."""
        return {"centre": self.centre, "velocity": self.velocity, "n_iterations": np.array(float(self.n_iterations))}

    def restore(self, state: Mapping[str, FloatArray]) -> None:
        """Resume from what `state` returned, in a search with the same settings and seed."""
        self.centre, self.velocity = np.array(state["centre"]), np.array(state["velocity"])
        self.n_iterations = int(state["n_iterations"])

    def _directions(self) -> FloatArray:
        """Return the iteration's directions (n_directions, D), the same at every call."""
        generator = np.random.default_rng([self._seed, self.n_iterations])
        directions = generator.standard_normal((self.settings.n_directions, len(self.centre)))
        return np.asarray(directions * self._scale)


def _fallen(end: float, done: float) -> float:
    return 1.0 + (end - 1.0) * min(max(done, 0.0), 1.0)
