"""The gymnasium environments, made the same way wherever a policy is trained, pruned or evaluated."""

import functools
import importlib
import json
import multiprocessing
import re
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from otr.control.environments import NOT_AFRESH, MadeAnew, depends_on_past
from otr.control.spaces import flattened
from pipelines.config.env import EnvConfig, PidTerms, search_here
from pipelines.errors import ConfigError, did_you_mean
from pipelines.play.pid_environment import PidObservation


def make_env(env: EnvConfig) -> gym.Env:
    """Return a new environment with its time limit, whose episodes depend on their seeds alone (`is_made_anew`).

    The environment checker is left out: it costs time at every step and checks the environment's implementation.
    The thesis's tables use the MuJoCo environments' v4 on purpose, so gymnasium's notice of a newer one is silenced.
    For a PID policy the environment shows [s, P, I, D] in place of its state.
    """
    made = MadeAnew(functools.partial(_make, env)) if is_made_anew(env) else _make(env)
    return made if env.pid is None else _with_pid_terms(made, env.id, env.pid)


def is_made_anew(env: EnvConfig) -> bool:
    """Return whether an environment is recreated for every seeded reset, as its episodes depend on those before.

    Of gymnasium's these are known; a custom one is checked on a few short episodes.
    """
    if env.id in NOT_AFRESH:
        return True
    spec = spec_of(env.id)
    is_gymnasiums = str(spec.entry_point).startswith("gymnasium.envs.") and not spec.additional_wrappers
    return not is_gymnasiums and _depends_on_past(env.id, json.dumps(env.kwargs, sort_keys=True))


@functools.cache
def _depends_on_past(env_id: str, kwargs: str) -> bool:
    depends = depends_on_past(functools.partial(_make, EnvConfig(env_id, env_id, env_id, json.loads(kwargs))))
    if depends and multiprocessing.parent_process() is None:  # once, not in every worker
        print(f"{env_id}: its episodes depend on those before; it is recreated for each", file=sys.stderr, flush=True)
    return depends


def _make(env: EnvConfig) -> gym.Env:
    spec = spec_of(env.id)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date.*")
        try:
            if "mujoco" in str(spec.entry_point):
                _hear_mujoco_warnings()
            made = gym.make(spec, disable_env_checker=True, **env.kwargs)
        except Exception as error:  # foreign code can fail in any way
            arguments = env.kwargs or "no arguments"
            raise ConfigError(f"env.id={env.id} with {arguments} cannot be made: {error_line(error)}") from error
        try:
            return flattened(made)
        except ValueError as error:
            raise ConfigError(f"{env.id}: {error}") from error


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
        what = f"there is no such module, installed or in {Path.cwd()}" if missing else error_line(error)
        raise ConfigError(f"environment {env_id}: module {module} cannot be imported: {what}") from error


def error_line(error: Exception) -> str:
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
    if isinstance(actions, gym.spaces.Discrete):
        return True
    is_vector = isinstance(actions, gym.spaces.Box) and len(actions.shape) == 1 and actions.is_bounded()
    if is_vector and np.issubdtype(actions.dtype, np.floating):
        return False
    raise ConfigError(
        f"{_id(env)}: the actions are {actions}; policies here choose one of n labels, Discrete(n), or give "
        "a vector of real numbers, a Box of one dimension with limits. Wrap the environment, as "
        "gymnasium.wrappers.TransformAction and RescaleAction do, and register it so"
    )


def _id(env: gym.Env) -> str:
    return env.spec.id if env.spec else str(env)


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
    """Return the length of the state vector; refuse one of none."""
    (n,) = env.observation_space.shape or (0,)
    if n == 0:
        raise ConfigError(f"{_id(env)}: the observations {env.observation_space} have no numbers")
    return int(n)
