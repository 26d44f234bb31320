"""Between a policy's vectors and answers and the spaces of a gymnasium environment, which may be of other kinds."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from otr.core.heads import Argmax, Identity, Sign

_VECTORS = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)


class LabelsFromZero(gym.ActionWrapper[Any, Any, Any]):
    """An environment whose actions 0, 1, ... are start, start + 1, ... of the one inside."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        inner = env.action_space
        assert isinstance(inner, spaces.Discrete)
        self._start = inner.start
        self.action_space = spaces.Discrete(int(inner.n))

    def action(self, action: Any) -> Any:
        """Return the action of the environment inside."""
        return self._start + action


def flattened(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """Return an environment as policies see it: one that is not so already is wrapped.

    Dictionaries, tuples, labels and arrays become one vector (gymnasium's FlattenObservation: labels as 0 and 1 each).

    Raises:
        ValueError: observations are images, or cannot be a vector; actions are of several labels.
    """
    seen, acts = env.observation_space, env.action_space
    if images := [each for each in _parts(seen) if _is_image(each)]:
        raise ValueError(
            f"the observations are images, {images[0]}, and image policies are out of scope. Accepted is what is a "
            "vector of numbers, such as the positions and speeds of what the image shows"
        )
    if isinstance(acts, spaces.MultiDiscrete):
        raise ValueError(
            f"the actions are {acts}, several labels at once, and a tree answers with one: let the environment take "
            f"one of {np.prod(acts.nvec)} labels, by a gymnasium.ActionWrapper that splits it "
            f"(numpy.unravel_index(label, {tuple(acts.nvec.tolist())})), and train with that"
        )
    if not isinstance(seen, spaces.Box) or len(seen.shape) != 1:
        if not all(isinstance(each, _VECTORS) for each in _parts(seen)):
            raise ValueError(f"the observations are {seen}, which no vector of one length holds; wrap the environment")
        env = gym.wrappers.FlattenObservation(env)
    return LabelsFromZero(env) if isinstance(acts, spaces.Discrete) and acts.start != 0 else env


def names_of(space: spaces.Space[Any]) -> list[str]:
    """Return names of the numbers of a flattened observation, from the keys of its dictionary; none without keys."""
    if not isinstance(space, spaces.Dict):
        return []
    names = []
    for key, part in space.spaces.items():
        name, inner = re.sub(r"\W+", "_", str(key)), names_of(part)
        n = int(np.prod(spaces.flatten_space(part).shape or (0,)))
        inner = [f"_{each}" for each in inner] or ([str(i) for i in range(n)] if n > 1 else [""])
        names += [f"{name}{each}" for each in inner]
    return names if len(set(names)) == len(names) and all(each[:1].isalpha() for each in names) else []


def keyed_names(env: gym.Env[Any, Any]) -> list[str]:
    """Return `names_of` the observations that `flattened` flattens, of an environment or one that it has wrapped."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.FlattenObservation):
            return names_of(env.env.observation_space)
        env = env.env
    return []


def _parts(space: spaces.Space[Any]) -> list[spaces.Space[Any]]:
    if isinstance(space, spaces.Dict | spaces.Tuple):
        inner = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
        return [part for each in inner for part in _parts(each)]
    return [space]


def _is_image(space: spaces.Space[Any]) -> bool:
    return isinstance(space, spaces.Box) and len(space.shape) in (2, 3) and space.dtype == np.uint8


def answer_reader(env: gym.Env[Any, Any]) -> Callable[[Any, int], NDArray[Any]]:
    """Return the function from the answers to n states to actions (n, a), or labels (n,).

    Continuous actions are rounded to the action space's own type (float32), as a trained policy's are: policies that
    are equal up to the last bits of float64 then play the same episode.
    """
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


def deciding(policy: Any, predict: Callable[[Any], Any], env: gym.Env[Any, Any]) -> Callable[[Any], Any]:
    """Return `predict`, or, of a policy that leaves open which output decides, the largest one's label."""
    space = env.action_space
    if not (isinstance(getattr(policy, "head", None), Identity) and isinstance(space, spaces.Discrete)):
        return predict
    return (lambda states: np.asarray(predict(states)).argmax(axis=1)) if policy.n_outputs == space.n else predict


def with_answers(policy: Any, env: gym.Env[Any, Any]) -> Any:
    """Return a network with a head that answers with an environment's actions, where its own leaves that open."""
    space = env.action_space
    if isinstance(policy.head, Sign):
        return of_two_outputs(policy)
    if not isinstance(policy.head, Identity):
        return policy
    if isinstance(space, spaces.Discrete):
        return policy.replace(head=Argmax()) if policy.n_outputs == space.n else policy
    if isinstance(space, spaces.Box) and space.is_bounded():
        return policy.replace(
            head=policy.head.clipped_to(*(np.float64(side).ravel() for side in (space.low, space.high)))
        )
    return policy


def of_two_outputs(policy: Any) -> Any:
    """Return a network whose output y decides between two labels (`Sign`) as one of outputs 0 and y; else itself."""
    if not isinstance(policy.head, Sign):
        return policy
    weights = [*policy.weights[:-1], np.vstack((0 * policy.weights[-1], policy.weights[-1]))]
    biases = [*policy.biases[:-1], np.append(0.0, policy.biases[-1])]
    return policy.replace(weights=weights, biases=biases, head=Argmax())


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
