"""What an environment's policies map: lengths, names and limits of states and of actions."""

import dataclasses
import functools
import json
from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from otr.control import pid_observation_names
from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.environments import flat_state_size, is_discrete, make_env


@dataclass(frozen=True)
class Spaces:
    """What an environment's policies map: states of `n_inputs` numbers to labels or to actions in a box."""

    n_inputs: int  # length of the state vector
    n_actions: int  # number of labels, or of the action's components
    # Least and greatest actions, (n_actions,) each; None where actions are labels
    box: tuple[np.ndarray, np.ndarray] | None
    states: tuple[np.ndarray, np.ndarray]  # least and greatest ones, (n_inputs,) each; infinite without bounds


def spaces(env: EnvConfig) -> Spaces:
    """Return what an environment's policies map; refuse observations and actions that no policy here has."""
    return _spaces(env.id, json.dumps(env.kwargs, sort_keys=True))


@functools.cache
def _spaces(env_id: str, kwargs: str) -> Spaces:
    env = make_env(EnvConfig(env_id, env_id, env_id, json.loads(kwargs)))
    n_inputs, states, actions = flat_state_size(env), env.observation_space, env.action_space
    is_discrete(env)  # refuses what is neither labels nor a box
    env.close()
    assert isinstance(states, gym.spaces.Box)
    limits = _bounds(states)
    if isinstance(actions, gym.spaces.Discrete):
        return Spaces(n_inputs, int(actions.n), None, limits)
    assert isinstance(actions, gym.spaces.Box)
    box = _bounds(actions)
    return Spaces(n_inputs, len(box[0]), box, limits)


def _bounds(space: gym.spaces.Box) -> tuple[np.ndarray, np.ndarray]:
    bounds = np.stack((space.low.ravel(), space.high.ravel())).astype(np.float64)
    bounds.flags.writeable = False  # cached for all callers
    return bounds[0], bounds[1]


def state_limits(env: EnvConfig) -> tuple[np.ndarray, np.ndarray] | None:
    """Return `state_sides`; None where one is infinite."""
    low, high = state_sides(env)
    return (low, high) if np.isfinite([low, high]).all() else None


def state_sides(env: EnvConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest state, (d,) each; infinite without bounds, and for a PID policy's terms."""
    if env.pid is not None:
        infinite = np.full(4 * spaces(env).n_inputs, np.inf)
        return -infinite, infinite
    return spaces(env).states


def state_box(env: EnvConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return middle and half width of the box of states, (d,) each; refuse states without bounds.

    The half width of a number that the environment declares as constant is 1.
    """
    limits = state_limits(env)
    if limits is None:
        raise ConfigError(f"actor.rescale_inputs=true: the states of {env.id} have no bounds")
    low, high = limits
    return (low + high) / 2, np.where(low < high, (high - low) / 2, 1.0)


def feature_names(env: EnvConfig, n_inputs: int) -> list[str]:
    """Return the names of the observation's components, x0, x1, ... where the environment's file gives none."""
    if env.pid is not None:
        names: list[str] = pid_observation_names(feature_names(dataclasses.replace(env, pid=None), n_inputs // 4))
        return names
    return _names(env.feature_names, n_inputs, "x", "env.feature_names")


def action_names(env: EnvConfig, n_outputs: int) -> list[str]:
    """Return the names of the action's components or labels, a0, a1, ... where the environment's file gives none."""
    return _names(env.action_names, n_outputs, "a", "env.action_names")


def _names(given: list[str], n: int, prefix: str, where: str) -> list[str]:
    if given and len(given) != n:
        names = "name" if len(given) == 1 else "names"
        raise ConfigError(f"{where} has {len(given)} {names}, the policy has {n}: {', '.join(given)}")
    twice = sorted({name for name in given if given.count(name) > 1})
    if twice:
        raise ConfigError(f"{where} has {twice[0]!r} twice: give every one a name of its own")
    return list(given) or [f"{prefix}{i}" for i in range(n)]


def make_training_env(env: EnvConfig, *, rescale_inputs: bool) -> gym.Env:
    """Return a new environment as training sees it: its states rescaled from its box to [-1, 1], where that is set."""
    made = make_env(env)
    if not rescale_inputs:
        return made
    state_box(env)  # refuses what has no bounds
    return gym.wrappers.RescaleObservation(made, np.float32(-1.0), np.float32(1.0))
