"""The gymnasium environments, made the same way wherever a policy is trained, pruned or evaluated."""

import dataclasses
import functools
import json
import warnings
from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from otr.control import pid_observation_names
from pipelines.config.env import EnvConfig, PidTerms
from pipelines.errors import ConfigError
from pipelines.play.pid_environment import PidObservation


def make_env(env: EnvConfig) -> gym.Env:
    """Return a new environment with its time limit.

    The environment checker is left out: it costs time at every step and checks the environment's implementation.
    The thesis's tables use the MuJoCo environments' v4 on purpose, so gymnasium's notice of a newer one is silenced.
    For a PID policy the environment shows [s, P, I, D] in place of its state.
    """
    made = _make(env)
    return made if env.pid is None else _with_pid_terms(made, env.id, env.pid)


def _make(env: EnvConfig) -> gym.Env:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date.*")
        try:
            if "mujoco" in str(gym.spec(env.id).entry_point):
                _hear_mujoco_warnings()
            return gym.make(env.id, disable_env_checker=True, **env.kwargs)
        except (gym.error.Error, ImportError, TypeError) as error:
            raise ConfigError(f"env.id={env.id} with {env.kwargs or 'no arguments'} cannot be made: {error}") from error


def _with_pid_terms(env: gym.Env, env_id: str, terms: PidTerms) -> gym.Env:
    n_states = flat_state_size(env)
    if len(terms.goal) != n_states:
        raise ConfigError(
            f"method.goal={list(terms.goal)} has {len(terms.goal)} numbers, the states of {env_id} have {n_states}: "
            "give the state in which the system rests"
        )
    if is_discrete(env):
        raise ConfigError(f"method=pid needs continuous actions; {env_id} has labels")
    return PidObservation(env, terms)


def make_training_env(env: EnvConfig, *, rescale_inputs: bool) -> gym.Env:
    """Return a new environment as training sees it: its states rescaled from its box to [-1, 1], where that is set."""
    made = make_env(env)
    if not rescale_inputs:
        return made
    state_box(env)  # refuses what has no bounds
    return gym.wrappers.RescaleObservation(made, np.float32(-1.0), np.float32(1.0))


def _hear_mujoco_warnings() -> None:
    """Take MuJoCo's warnings as Python's; by default it prints them, and writes a file MUJOCO_LOG.TXT.

    Those of models that use deprecated attributes concern gymnasium's authors and come once per environment.
    """
    import mujoco

    def warn(text: str) -> None:
        if "deprecated" not in text:
            warnings.warn(f"MuJoCo: {text}", RuntimeWarning, stacklevel=2)

    mujoco.set_mju_user_warning(warn)


def is_discrete(env: gym.Env) -> bool:
    """Return whether actions are labels; refuse action spaces that are neither labels nor a box."""
    if isinstance(env.action_space, gym.spaces.Discrete):
        return True
    if isinstance(env.action_space, gym.spaces.Box):
        return False
    raise ConfigError(f"{env.spec.id if env.spec else env}: actions {env.action_space} are neither Box nor Discrete")


def feature_names(env: EnvConfig, n_inputs: int) -> list[str]:
    """Return the names of the observation's components, x0, x1, ... where the environment's file gives none."""
    if env.pid is not None:
        names: list[str] = pid_observation_names(feature_names(dataclasses.replace(env, pid=None), n_inputs // 4))
        return names
    return _names(env.feature_names, n_inputs, "x", f"conf/env/{env.name}.yaml: feature_names")


def action_names(env: EnvConfig, n_outputs: int) -> list[str]:
    """Return the names of the action's components or labels, a0, a1, ... where the environment's file gives none."""
    return _names(env.action_names, n_outputs, "a", f"conf/env/{env.name}.yaml: action_names")


def _names(given: list[str], n: int, prefix: str, where: str) -> list[str]:
    if given and len(given) != n:
        raise ConfigError(f"{where} has {len(given)} names, the policy has {n}")
    return list(given) or [f"{prefix}{i}" for i in range(n)]


def state_limits(env: EnvConfig) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lowest and the highest state, (d,) each; None where one has no bounds, or is a PID policy's."""
    return None if env.pid is not None else spaces(env).states


def state_box(env: EnvConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return middle and half width of the box of states, (d,) each; refuse states without bounds."""
    limits = state_limits(env)
    if limits is None:
        raise ConfigError(f"actor.rescale_inputs=true: the states of {env.id} have no bounds")
    low, high = limits
    return (low + high) / 2, (high - low) / 2


@dataclass(frozen=True)
class Spaces:
    """What an environment's policies map: states of `n_inputs` numbers to labels or to actions in a box."""

    n_inputs: int  # length of the state vector
    n_actions: int  # number of labels, or of the action's components
    # Least and greatest actions, (n_actions,) each; None where actions are labels
    box: tuple[np.ndarray, np.ndarray] | None
    # Least and greatest states, (n_inputs,) each; None where one has no bounds
    states: tuple[np.ndarray, np.ndarray] | None


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
    limits = _bounds(states) if states.is_bounded() else None
    if isinstance(actions, gym.spaces.Discrete):
        return Spaces(n_inputs, int(actions.n), None, limits)
    assert isinstance(actions, gym.spaces.Box)
    box = _bounds(actions)
    return Spaces(n_inputs, len(box[0]), box, limits)


def _bounds(space: gym.spaces.Box) -> tuple[np.ndarray, np.ndarray]:
    return space.low.ravel().astype(np.float64), space.high.ravel().astype(np.float64)


def episode_limit(env: EnvConfig) -> int:
    """Return the most steps of an episode; refuse an environment that has no limit."""
    made = make_env(env)
    made.close()
    limit = made.spec.max_episode_steps if made.spec else None
    if limit is None:
        raise ConfigError(f"{env.id}: episodes have no limit; give one as +env.kwargs.max_episode_steps=1000")
    return int(limit)


def flat_state_size(env: gym.Env) -> int:
    """Return the length of the state vector; refuse observations that are not a flat box."""
    space = env.observation_space
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise ConfigError(f"{env.spec.id if env.spec else env}: observations {space} are not a vector")
    return int(np.prod(space.shape))
