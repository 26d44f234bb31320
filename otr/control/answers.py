"""From the answers of a policy to the actions of a gymnasium environment."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import gymnasium as gym


def answer_reader(env: gym.Env[Any, Any]) -> Callable[[Any, int], NDArray[Any]]:
    """Return the function from the answers to n states to actions (n, a), or labels (n,).

    Continuous actions are rounded to the action space's own type (float32), as a trained policy's are: policies that
    are equal up to the last bits of float64 then play the same episode.
    """
    from gymnasium import spaces

    seen, space = env.observation_space, env.action_space
    if not isinstance(seen, spaces.Box):
        raise ValueError(
            f"the observations are {seen}, expected a Box; wrap the environment, as in "
            "gymnasium.wrappers.FlattenObservation"
        )
    if isinstance(space, spaces.Discrete) and space.start == 0:
        return functools.partial(_labels, n_labels=int(space.n))
    if not isinstance(space, spaces.Box):
        raise ValueError(f"the actions are {space}, expected a Box, or Discrete from 0 on; wrap the environment")
    return functools.partial(_actions, shape=space.shape, dtype=space.dtype)


def _labels(answers: Any, n: int, n_labels: int) -> NDArray[np.int64]:
    labels = _array(answers)
    if labels.shape != (n,) or labels.dtype.kind not in "iu" or labels.min() < 0 or labels.max() >= n_labels:
        raise ValueError(
            f"the policy answers {_shown(answers)}, expected labels (n,) from 0 to {n_labels - 1} for n = {n} states"
        )
    return labels.astype(np.int64)


def _actions(answers: Any, n: int, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    actions, size = _array(answers), math.prod(shape)
    if actions.shape == (n,) and actions.dtype.kind in "iu" and np.issubdtype(dtype, np.floating):
        raise ValueError(
            f"the policy answers with labels, {_shown(answers)}, and the environment takes real actions (n, {size}); "
            "give a policy of continuous actions, or an environment with Discrete ones"
        )
    if actions.shape[:1] != (n,) or actions.size != n * size or not np.isfinite(actions).all():
        raise ValueError(
            f"the policy answers {_shown(answers)}, expected finite actions (n, {size}) for n = {n} states"
        )
    if np.issubdtype(dtype, np.integer):
        actions, held = np.rint(actions), np.iinfo(dtype)
        if (actions < held.min).any() or (actions > held.max).any():
            raise ValueError(
                f"the policy answers {_shown(answers)}; the actions are of type {dtype}, from {held.min} to {held.max}"
            )
    return np.asarray(actions.astype(dtype).reshape(-1, *shape))


def _array(answers: Any) -> NDArray[Any]:
    if isinstance(answers, tuple):
        raise ValueError(
            f"the policy answers a tuple of {len(answers)}, expected an array of one action a state; of a model of "
            "Stable-Baselines3, give lambda X: model.predict(X, deterministic=True)[0]"
        )
    return np.asarray(answers)


def _shown(answers: Any) -> str:
    array = np.asarray(answers)
    return f"an array of shape {array.shape} and type {array.dtype}, first {array.ravel()[:1].tolist()}"
