"""The gymnasium environments, made the same way wherever a policy is trained, pruned or evaluated."""

import dataclasses
import functools
import importlib
import json
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from otr.control import pid_observation_names
from pipelines.config.env import EnvConfig, PidTerms, search_here
from pipelines.errors import ConfigError, did_you_mean
from pipelines.play.pid_environment import PidObservation

SAME_STATE = 1e-6  # by how much the state after a reset may differ, absolute and relative, where the seed is the same


def make_env(env: EnvConfig) -> gym.Env:
    """Return a new environment with its time limit.

    The environment checker is left out: it costs time at every step and checks the environment's implementation.
    The thesis's tables use the MuJoCo environments' v4 on purpose, so gymnasium's notice of a newer one is silenced.
    For a PID policy the environment shows [s, P, I, D] in place of its state.
    """
    made = _make(env)
    return made if env.pid is None else _with_pid_terms(made, env.id, env.pid)


def _make(env: EnvConfig) -> gym.Env:
    spec = spec_of(env.id)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date.*")
        try:
            if "mujoco" in str(spec.entry_point):
                _hear_mujoco_warnings()
            return gym.make(spec, disable_env_checker=True, **env.kwargs)
        except Exception as error:  # foreign code can fail in any way
            arguments = env.kwargs or "no arguments"
            raise ConfigError(f"env.id={env.id} with {arguments} cannot be made: {_told(error)}") from error


def spec_of(env_id: str) -> Any:
    """Return what gymnasium has registered under an id (an `EnvSpec`).

    `module:Id` imports the module first, an installed one or one of the folder in which the command was started.

    Raises:
        ConfigError: there is no such module, or no such id; names the nearest ones.
    """
    module, _, name = env_id.rpartition(":")
    if module:
        _import(module, env_id)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date.*")
        try:
            return gym.spec(name)
        except gym.error.Error as error:
            raise ConfigError(f"environment {env_id}: {_first_sentence(error)}.{_near(name, module)}") from error


def registered_ids() -> list[str]:
    """Return the ids that gymnasium has registered."""
    return sorted(gym.registry)


def _import(module: str, env_id: str) -> None:
    search_here()
    try:
        importlib.import_module(module)
    except Exception as error:  # foreign code can fail in any way
        missing = isinstance(error, ModuleNotFoundError) and error.name == module.split(".")[0]
        what = f"there is no such module, installed or in {Path.cwd()}" if missing else _told(error)
        raise ConfigError(f"environment {env_id}: module {module} cannot be imported: {what}") from error


def _told(error: Exception) -> str:
    """Return an error of foreign code in one line, with its kind unless it is one of gymnasium's own."""
    return str(error) if isinstance(error, gym.error.Error) else f"{type(error).__name__}: {error}"


def _first_sentence(error: Exception) -> str:
    return re.split(r"\. |\.$", str(error), maxsplit=1)[0]


def _near(name: str, module: str) -> str:
    """Return a question with the ids nearest to one that is not registered; of a module, its own."""
    if not module:
        return did_you_mean(name, [], unlisted=registered_ids())
    made_by = {env_id: spec.entry_point for env_id, spec in gym.registry.items()}  # "module:Class", or the class itself
    own = [env_id for env_id, made in made_by.items() if getattr(made, "__module__", str(made)).startswith(module)]
    return (
        did_you_mean(f"{module}:{name}", [f"{module}:{env_id}" for env_id in own])
        if own
        else f" Module {module} registers none"
    )


def own_environment(env_id: str, kwargs: Mapping[str, Any]) -> EnvConfig:
    """Return the settings of an environment that conf/env has no file for.

    Its name is the id as a folder can have it. Names of the observation's and the action's components are those that
    the environment's class gives as ``metadata["feature_names"]`` and ``metadata["action_names"]``, if any.

    Raises:
        ConfigError: there is no such environment, its observations or actions are of a kind that no policy here has, or
            a first reset and step do not give what gymnasium's interface says.
    """
    env = EnvConfig(re.sub(r"[^\w.-]+", "_", env_id), "", env_id, dict(kwargs))
    task = "discrete" if spaces(env).box is None else "continuous"
    made = make_env(env)
    _try_out(made, env_id)
    features, actions = (list(made.metadata.get(key, [])) for key in ("feature_names", "action_names"))
    made.close()
    return dataclasses.replace(env, task=task, kwargs={}, feature_names=features, action_names=actions)


def _try_out(env: gym.Env, env_id: str) -> None:
    """Reset and step twice; raise ConfigError where that fails, or gives what spaces or interface do not allow.

    The second time the same has to come out, unless the environment is registered as not deterministic: every method
    is to play the same episodes.
    """
    env.action_space.seed(0)
    action, seen = env.action_space.sample(), []
    call = "reset(seed=0)"
    try:
        for call in ("reset(seed=0)", "a second reset(seed=0)"):
            state, _ = env.reset(seed=0)
            _check_state(state, env)
            seen.append(np.asarray(state, dtype=np.float64))
            call = "step(action)"
            state, reward, *_ = env.step(action)
            _check_state(state, env)
            seen.append(np.append(state, float(reward)))
    except Exception as error:  # foreign code can fail in any way
        raise ConfigError(
            f"environment {env_id}: {call} fails: {_told(error)}. In gymnasium, reset(seed=..., options=...) returns "
            "(observation, info), and step(action) returns (observation, reward, terminated, truncated, info); "
            "gymnasium.utils.env_checker.check_env checks all of that, and debug=true shows where it fails"
        ) from error
    if env.spec is not None and env.spec.nondeterministic:
        return
    for call, first, second in (("reset(seed=0)", seen[0], seen[2]), ("the first step after it", seen[1], seen[3])):
        if not np.allclose(first, second, rtol=SAME_STATE, atol=SAME_STATE, equal_nan=True):
            raise ConfigError(
                f"environment {env_id}: {call} gives {first} and, again, {second}. Methods are compared on the same "
                "episodes, which a seed decides: let reset call super().reset(seed=seed) and draw from self.np_random, "
                "or register the environment with nondeterministic=True, and no two policies play the same episodes"
            )


def _check_state(state: Any, env: gym.Env) -> None:
    values, wanted = np.asarray(state), env.observation_space.shape
    if values.shape != wanted:
        raise ValueError(f"the observation has shape {values.shape}, the observation space {wanted}")
    if not np.isfinite(values.astype(np.float64)).all():
        raise ValueError(f"the observation is not finite: {values}")


def check_environment(env: EnvConfig) -> None:
    """Raise ConfigError unless an environment's arguments can be recorded, it runs with them, and its names fit.

    Arguments are recorded as JSON, which has no infinite numbers; names are as many as the inputs and actions, no two
    the same, not even of an input and an action.
    """
    for name, value in env.kwargs.items():
        try:
            json.dumps(value, allow_nan=False)
        except ValueError as error:
            raise ConfigError(f"env.kwargs.{name}={value}: expected finite numbers, or text in quotes") from error
    if env.kwargs:
        _try_out_with(env.id, json.dumps(env.kwargs, sort_keys=True))
    space, plain = spaces(env), dataclasses.replace(env, pid=None)
    shared = set(feature_names(plain, space.n_inputs)) & set(action_names(plain, space.n_actions))
    if shared:
        raise ConfigError(f"env.action_names has {min(shared)!r}, which is a feature's name, too: give it another one")


@functools.cache
def _try_out_with(env_id: str, kwargs: str) -> None:
    made = make_env(EnvConfig(env_id, env_id, env_id, json.loads(kwargs)))
    _try_out(made, env_id)
    made.close()


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
    """Return whether actions are labels 0, 1, ...; refuse actions that are neither these nor a vector in a box."""
    actions = env.action_space
    if isinstance(actions, gym.spaces.Discrete) and int(actions.start) == 0:
        return True
    is_vector = isinstance(actions, gym.spaces.Box) and len(actions.shape) == 1 and actions.is_bounded()
    if is_vector and np.issubdtype(actions.dtype, np.floating):
        return False
    raise ConfigError(
        f"{_id(env)}: the actions are {actions}; policies here choose one of n labels, Discrete(n) from 0 on, or give "
        "a vector of real numbers, a Box of one dimension with limits. Wrap the environment, as "
        "gymnasium.wrappers.TransformAction and RescaleAction do, and register it so"
    )


def _id(env: gym.Env) -> str:
    return env.spec.id if env.spec else str(env)


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


def state_limits(env: EnvConfig) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lowest and the highest state, (d,) each; None where one has no bounds, or is a PID policy's.

    A number that the environment declares as constant has the least width that single precision tells from none, as a
    domain needs an inside.
    """
    limits = None if env.pid is not None else spaces(env).states
    if limits is None:
        return None
    low, high = limits
    margin = np.where(low < high, 0.0, np.finfo(np.float32).eps * np.maximum(1.0, np.abs(high)))
    return low - margin, high + margin


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
    limit = env.kwargs.get("max_episode_steps") or spec_of(env.id).max_episode_steps
    if limit is None:
        raise ConfigError(
            f"{env.id}: episodes have no limit, so one may never end; give one as "
            "+env.kwargs.max_episode_steps=1000, or where the environment is registered"
        )
    return int(limit)


def flat_state_size(env: gym.Env) -> int:
    """Return the length of the state vector; refuse observations that are not a flat box."""
    space = env.observation_space
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1 or space.shape[0] == 0:
        raise ConfigError(
            f"{_id(env)}: observations {space} are not a vector of numbers, a Box of one dimension, which programs "
            "read. Wrap the environment, as gymnasium.wrappers.FlattenObservation does, and register it so"
        )
    return int(space.shape[0])
