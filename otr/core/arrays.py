"""Types of arrays, and the checks of states that every part of the library shares."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def as_states(X: ArrayLike, n_inputs: int) -> FloatArray:
    """Return `X` as float64 (n, n_inputs) or, for a single state, (n_inputs,); raise ValueError for other shapes."""
    states: FloatArray = np.asarray(X, dtype=np.float64)
    if states.ndim not in (1, 2) or states.shape[-1] != n_inputs:
        raise ValueError(
            f"states have shape {states.shape}, expected (n, {n_inputs}) or ({n_inputs},): "
            f"one column for each of the {n_inputs} inputs"
        )
    return states


def as_batch(X: ArrayLike, n_inputs: int) -> FloatArray:
    """Return `X` as float64 of shape (n, n_inputs); a single state becomes a batch of one."""
    return np.atleast_2d(as_states(X, n_inputs))


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return a view of `array` that refuses assignment."""
    view = array.view()
    view.flags.writeable = False
    return view


def with_read_only_arrays(state: dict[str, Any]) -> dict[str, Any]:
    """Return attributes, as a copy or a pickle has them, whose arrays, also those in tuples, refuse assignment."""

    def locked(value: Any) -> Any:
        if type(value) is tuple:
            return tuple(map(locked, value))
        return read_only(value) if isinstance(value, np.ndarray) else value

    return {name: locked(value) for name, value in state.items()}
