"""Recipes: what a budget means for a method and an environment, as overrides (conf/recipe/<budget>.yaml).

conf/implied.yaml has what a method or an algorithm means under every budget.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import yaml  # type: ignore[import-untyped]

from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.hardened_methods import SoftConfig
from pipelines.config.method import MethodConfig
from pipelines.config.methods import METHODS

TRAINED_BY = ("algo", "trainer")  # groups that say who trains
OF_TRAINING = (*TRAINED_BY, "actor", "train")  # groups that a given policy does not read


@functools.cache
def recipes(budget: str) -> dict[str, dict[str, list[str]]]:
    """Return a budget's recipes by method and environment; none where it has no file."""
    return _read(f"recipe/{budget}.yaml") if (CONF_DIR / "recipe" / f"{budget}.yaml").is_file() else {}


def recipe(given: Mapping[str, str], method: str | None = None) -> list[str]:
    """Return the overrides of the recipe for what is given, by key: of the environment, or of another version of it.

    One of the environment with this depth, as `halfcheetah/32`, comes before that of the environment.

    `method` is in place of the given one: `default` is the recipe of a command that names none.
    """
    env, widths = given.get("env", ""), given.get("depth", "").strip("[] ")  # depth=[32] is depth=32
    by_env = recipes(given.get("budget") or _default_budget()).get(method or given.get("method", "otr"), {})
    names = [f"{name}{depth}" for name in (env, env.rsplit("_v", 1)[0]) for depth in (f"/{widths}", "")]
    return next((by_env[name] for name in names if name in by_env), [])


def remaining(overrides: Sequence[str], given: Mapping[str, str]) -> list[str]:
    """Return the overrides of a recipe that come before those given, by key: a given key keeps its given value.

    A recipe with another algorithm or trainer than the given one loses its overrides of training.
    """
    is_other_training = any(key in given and f"{key}={given[key]}" not in overrides for key in TRAINED_BY)
    taken = (*OF_TRAINING, "oracle") if is_other_training else ()
    keys = {override: override.partition("=")[0] for override in overrides}
    return [
        override
        for override in overrides
        if keys[override] not in given and keys[override].partition(".")[0] not in taken
    ]


def always_implied(given: Mapping[str, str]) -> list[str]:
    """Return the overrides that the method, the algorithm and the trainer given, by key, mean under every budget.

    A soft tree is trained by the algorithm that its environment has for such, where none is given.
    """
    implied, algo = _read("implied.yaml"), given.get("algo", "")
    method = METHODS.get(name := given.get("method", "otr"), MethodConfig)
    if issubclass(method, SoftConfig) and not algo:
        files = (f"ppo_{name}_{given.get('env', '')}", f"ppo_tree_{given.get('env', '')}", "ppo_tree")
        algo = next(file for file in files if (CONF_DIR / "algo" / f"{file}.yaml").is_file())
    kind = "on_policy" if issubclass(method, SoftConfig) and algo != "sac" else algo.partition("_")[0]
    overrides = [override for key in (kind, name, given.get("trainer")) for override in implied.get(key, [])]
    overrides += [f"algo={algo}"] if algo else []
    unread = given.keys() if method.imitates else {*given, "oracle"}
    return [override for override in overrides if override.partition("=")[0] not in unread]


def _default_budget() -> str:
    """Return the budget that conf/run.yaml names."""
    return next(str(entry["budget"]) for entry in _read("run.yaml")["defaults"] if "budget" in entry)


@functools.cache
def _read(path: str) -> Any:
    return yaml.safe_load((CONF_DIR / path).read_text(encoding="utf-8"))
