"""All heads: the outputs themselves, expected counts, three boxes of actions, and two for labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from otr.core.arrays import BoolArray, FloatArray, IntArray, read_only
from otr.core.head import Head
from otr.errors import ArtefactError, InvalidNetworkError

_ROUNDING = 1e-9  # of its range, by which a squashed answer may be beyond a box that it is to be clipped to


class Identity(Head):
    """The affine outputs are the answer."""

    name = "identity"
    words = "the outputs are the answer"
    is_projection = True

    def __call__(self, Y: FloatArray) -> NDArray[Any]:
        return Y

    def slopes(self, n_outputs: int) -> FloatArray | None:
        return np.ones(n_outputs)

    def clipped_to(self, low: FloatArray, high: FloatArray) -> Head:
        return ClipBox(low, high)


class Exp(Head):
    """exp(y): the expected count of a Poisson regression, whose link is the logarithm; inf for y above 709.7."""

    name = "exp"
    words = "exp of the outputs"

    def __call__(self, Y: FloatArray) -> NDArray[Any]:
        with np.errstate(over="ignore"):
            return np.asarray(np.exp(Y))


class _Box(Head):
    """A head whose answers are in the box [low, high]."""

    def __init__(self, low: ArrayLike, high: ArrayLike) -> None:
        """Keep the limits, each a number or of shape (o,).

        Raises:
            InvalidNetworkError: a limit is not finite, low is not below high, or the shapes differ.
        """
        # Added to zero, -0.0 becomes 0.0: equal heads then have the same description and the same hash.
        self.low: FloatArray = read_only(np.asarray(np.array(low, dtype=np.float64) + 0.0))
        self.high: FloatArray = read_only(np.asarray(np.array(high, dtype=np.float64) + 0.0))
        if self.low.shape != self.high.shape or self.low.ndim > 1:
            raise InvalidNetworkError(
                f"{type(self).__name__}: low has shape {self.low.shape} and high {self.high.shape}; "
                "give two numbers or two arrays of shape (n_outputs,)"
            )
        if not (np.isfinite(self.low).all() and np.isfinite(self.high).all() and (self.low < self.high).all()):
            raise InvalidNetworkError(
                f"{type(self).__name__}: need finite low < high in every output, "
                f"got low={self.low.tolist()}, high={self.high.tolist()}"
            )

    def check(self, n_outputs: int) -> None:
        if self.low.ndim == 1 and len(self.low) != n_outputs:
            raise InvalidNetworkError(
                f"{type(self).__name__} has limits for {len(self.low)} outputs, the network has {n_outputs}"
            )

    def limits(self, n_outputs: int) -> tuple[FloatArray, FloatArray]:
        shape = (self.n_answers(n_outputs),)
        return np.broadcast_to(self.low, shape), np.broadcast_to(self.high, shape)

    def clip(self) -> ClipBox | None:
        return ClipBox(self.low, self.high)

    def to_dict(self) -> dict[str, Any]:
        return {"name": self.name, "low": self.low.tolist(), "high": self.high.tolist()}


class _TanhHead(_Box):
    """A head whose answers are low + (tanh(u) + 1) / 2 * (high - low), for controls u."""

    def __init__(self, low: ArrayLike, high: ArrayLike) -> None:
        """Keep the limits, each a number or of shape (o,).

        Raises:
            InvalidNetworkError: as for the other boxes, or high - low is larger than a float64 can hold.
        """
        super().__init__(low, high)
        with np.errstate(over="ignore"):
            self._half = (self.high - self.low) / 2
        if not np.isfinite(self._half).all():
            raise InvalidNetworkError(
                f"{type(self).__name__}: high - low is larger than a float64 can hold, got low={self.low.tolist()}, "
                f"high={self.high.tolist()}; give a narrower box"
            )
        self._middle = self.low + self._half

    def __call__(self, Y: FloatArray) -> NDArray[Any]:
        answers: FloatArray = np.tanh(self.controls(Y))
        answers *= self._half
        answers += self._middle
        return answers

    def halves_and_middles(self, n_outputs: int) -> tuple[FloatArray, FloatArray]:
        """Return half the width and the middle of each answer's range, (n_answers,) each."""
        shape = (self.n_answers(n_outputs),)
        return np.broadcast_to(self._half, shape), np.broadcast_to(self._middle, shape)

    def clipped_to(self, low: FloatArray, high: FloatArray) -> Head:
        slack = _ROUNDING * (self.high - self.low)
        if (self.low < low - slack).any() or (self.high > high + slack).any():
            raise ValueError(
                f"the answers go through tanh to {self.low.tolist()} .. {self.high.tolist()}, the "
                f"actions are {low.tolist()} .. {high.tolist()}; scale the tanh to these"
            )
        return self


class TanhBox(_TanhHead):
    """low + (tanh(y) + 1) / 2 * (high - low): the action of a SAC, TD3 or DDPG actor."""

    name = "tanh_box"
    words = "tanh, scaled to"

    def slopes(self, n_outputs: int) -> FloatArray | None:
        return self.halves_and_middles(n_outputs)[0]

    def tangent(self, n_outputs: int) -> tuple[FloatArray, FloatArray] | None:
        return self.halves_and_middles(n_outputs)


class ClipBox(_Box):
    """min(max(y, low), high): the deterministic action of a PPO or A2C actor."""

    name = "clip_box"
    words = "clipped to"
    is_projection = True

    def __call__(self, Y: FloatArray) -> NDArray[Any]:
        # np.clip costs several times this on a single state.
        return np.minimum(np.maximum(Y, self.low), self.high)

    def slopes(self, n_outputs: int) -> FloatArray | None:
        return np.ones(n_outputs)

    def clipped_to(self, low: FloatArray, high: FloatArray) -> Head:
        both = np.clip(self.low, low, high), np.clip(self.high, low, high)
        if (both[0] >= both[1]).any():
            raise ValueError(
                f"a clip to {self.low.tolist()} .. {self.high.tolist()} leaves none of the actions "
                f"{low.tolist()} .. {high.tolist()}"
            )
        return ClipBox(*both)


class PidBox(_TanhHead):
    """A PID controller's action, squashed into the box [low, high] as `TanhBox` does (Orfanos 2023, Fig. 4.3).

    Of the outputs y the first 3 d are the terms phi = [P, I, D] and every further 3 d the gains theta_j of one action:

        u_j = theta_j . phi = theta_P . P + theta_I . I + theta_D . D
        answer_j = low + (tanh(u_j) + 1) / 2 * (high - low)

    so a leaf holds gains, which may be affine in the state, and the policy is an `ObliqueTree` like any other.
    """

    name = "pid_box"
    words = "the gains times the terms, then tanh, scaled to"
    acts_by_output = False
    terms = ("P", "I", "D")

    def __init__(self, low: ArrayLike, high: ArrayLike) -> None:
        """Keep the limits, of shape (a,) each: their length is the number of actions.

        Raises:
            InvalidNetworkError: as for the other boxes, or the limits are single numbers.
        """
        super().__init__(low, high)
        if self.low.ndim != 1:
            raise InvalidNetworkError(f"PidBox: low is {self.low.tolist()}; give arrays of one number an action")

    def n_terms(self, n_outputs: int) -> int:
        """Return how many terms phi has: 3 d."""
        return n_outputs // (len(self.low) + 1)

    def controls(self, Y: FloatArray) -> FloatArray:
        """Return u = theta . phi, the actions before the tanh: (n, a) for outputs Y (n, o), or (a,) for (o,)."""
        blocks = Y.reshape(*Y.shape[:-1], len(self.low) + 1, -1)
        controls: FloatArray = np.einsum("...am,...m->...a", blocks[..., 1:, :], blocks[..., 0, :])
        return controls

    def n_answers(self, n_outputs: int) -> int:
        return len(self.low)

    def output_names(self, n_outputs: int, answers: Sequence[str]) -> list[str]:
        """Return P0, ..., I0, ..., D0, ..., theta_P0, ... action by action, with its name where there are several."""
        d = self.n_terms(n_outputs) // len(self.terms)
        terms = [f"{term}{i}" for term in self.terms for i in range(d)]
        suffixes = [f"_{answer}" if len(answers) > 1 else "" for answer in answers]
        return [*terms, *(f"theta_{term}{suffix}" for suffix in suffixes for term in terms)]

    def check(self, n_outputs: int) -> None:
        unit = 3 * (len(self.low) + 1)
        if n_outputs == 0 or n_outputs % unit:
            raise InvalidNetworkError(
                f"PidBox with {len(self.low)} actions needs a multiple of {unit} outputs, the terms P, I, D and each "
                f"action's gains; the network has {n_outputs}"
            )


class Sign(Head):
    """Binary label of one output: 0 where y <= 0, else 1."""

    name = "sign"
    words = "1 where the output is above 0, else 0"
    gives_labels = True

    def __call__(self, Y: FloatArray) -> NDArray[Any]:
        return (Y[..., 0] > 0).astype(np.int64)

    def check(self, n_outputs: int) -> None:
        if n_outputs != 1:
            raise InvalidNetworkError(f"Sign needs 1 output, the network has {n_outputs}; use Argmax for several")

    def n_labels(self, n_outputs: int) -> int:
        return 2

    def weights_of_label(self, label: int, n_outputs: int) -> FloatArray:
        """Return the label itself, 0 or 1."""
        return np.array([float(label)])

    def n_tests(self, n_outputs: int) -> int:
        return 1

    def tests(self, Y: FloatArray) -> BoolArray:
        return Y > 0

    def labels(self, outcomes: BoolArray) -> IntArray | None:
        return outcomes[:, 0].astype(np.int64)

    def champions(self, outcomes: BoolArray) -> IntArray:
        return np.full(outcomes.shape, -1, dtype=np.int64)


class Argmax(Head):
    """Label of the largest output; a tie goes to the lowest index, as in numpy.

    As tests it is a tournament: champion i = 0, and for challenger j = 1 .. o-1 the test `y_j - y_i <= 0` keeps the
    champion on the left and puts j in its place on the right.
    """

    name = "argmax"
    words = "the label of the largest output, the first of equals"
    gives_labels = True

    def __call__(self, Y: FloatArray) -> NDArray[Any]:
        return np.asarray(Y.argmax(axis=-1))

    def n_tests(self, n_outputs: int) -> int:
        return n_outputs - 1

    def tests(self, Y: FloatArray) -> BoolArray:
        best = np.maximum.accumulate(Y, axis=1)
        return Y[:, 1:] > best[:, :-1]

    def labels(self, outcomes: BoolArray) -> IntArray | None:
        if outcomes.shape[1] == 0:
            return np.zeros(len(outcomes), dtype=np.int64)
        last_win = outcomes.shape[1] - outcomes[:, ::-1].argmax(axis=1)
        return np.where(outcomes.any(axis=1), last_win, 0)

    def champions(self, outcomes: BoolArray) -> IntArray:
        champions = np.zeros(outcomes.shape, dtype=np.int64)
        challengers = np.arange(1, outcomes.shape[1], dtype=np.int64)
        champions[:, 1:] = np.maximum.accumulate(np.where(outcomes[:, :-1], challengers, 0), axis=1)
        return champions

    @property
    def first_challenger(self) -> int:
        return 1


HEADS: dict[str, type[Head]] = {head.name: head for head in (Identity, Exp, TanhBox, ClipBox, PidBox, Sign, Argmax)}


def head_from_dict(description: Mapping[str, Any]) -> Head:
    """Return the head that `Head.to_dict` described.

    Raises:
        ArtefactError: the name is unknown or the limits are missing.
        InvalidNetworkError: the limits are no box.

    Examples:
        >>> otr.head_from_dict({"name": "clip_box", "low": -1, "high": 1})
        ClipBox(low=-1.0, high=1.0)
    """
    arguments = {key: value for key, value in description.items() if key != "name"}
    name = description.get("name")
    if name not in HEADS:
        raise ArtefactError(f"unknown head {name!r}; known heads: {', '.join(sorted(HEADS))}")
    try:
        return HEADS[name](**arguments)
    except TypeError as error:
        raise ArtefactError(f"head {name!r} cannot be made from {arguments}: {error}") from error
