"""Recipes: what a budget means for a method and an environment, as overrides (conf/recipe/<budget>.yaml)."""

import functools
from collections.abc import Mapping, Sequence

import yaml  # type: ignore[import-untyped]

from pipelines.config.conf_dir import CONF_DIR

TRAINED_BY = ("algo", "trainer")  # groups that say who trains
OF_TRAINING = (*TRAINED_BY, "actor", "train")  # groups of which a policy that is there already reads nothing


@functools.cache
def recipes(budget: str) -> dict[str, dict[str, list[str]]]:
    """Return a budget's recipes by method and environment; none where it has no file."""
    path = CONF_DIR / "recipe" / f"{budget}.yaml"
    return yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else {}


def recipe(given: Mapping[str, str]) -> list[str]:
    """Return the overrides of the recipe for what is given, by key: of the environment, or of another version of it.

    Where neither a method nor who trains is given, the recipe `default` comes first, which may name a method.
    """
    by_method, env = recipes(given.get("budget") or _default_budget()), given.get("env", "")
    default = ["default"] if given.keys().isdisjoint(("method", *TRAINED_BY)) else []
    by_env = [by_method.get(method, {}) for method in (*default, given.get("method", "otr"))]
    return next((each[name] for each in by_env for name in (env, env.rsplit("_v", 1)[0]) if name in each), [])


def remaining(words: Sequence[str], given: Mapping[str, str]) -> list[str]:
    """Return the overrides of a recipe that stand before those given, by key: a key that is given is the giver's.

    Of a recipe with another algorithm or trainer than the given one nothing stands that is of training.
    """
    is_trained_otherwise = any(key in given and f"{key}={given[key]}" not in words for key in TRAINED_BY)
    taken = (*OF_TRAINING, "oracle") if is_trained_otherwise else ()
    keys = {word: word.partition("=")[0] for word in words}
    return [word for word in words if keys[word] not in given and keys[word].partition(".")[0] not in taken]


@functools.cache
def _default_budget() -> str:
    """Return the budget that conf/run.yaml names."""
    defaults = yaml.safe_load((CONF_DIR / "run.yaml").read_text(encoding="utf-8"))["defaults"]
    return next(str(entry["budget"]) for entry in defaults if isinstance(entry, dict) and "budget" in entry)
