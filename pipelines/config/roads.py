"""The cheapest measured roads of a budget to the published returns: conf/roads/<budget>.yaml."""

import functools
from dataclasses import dataclass, field

import yaml  # type: ignore[import-untyped]

from pipelines.config.conf_dir import CONF_DIR


@dataclass(frozen=True)
class Roads:
    """What a budget says of methods and tasks, in words: it is no part of a run's settings."""

    overrides: dict[str, dict[str, list[str]]] = field(default_factory=dict)  # which stand before those given
    expected: dict[str, dict[str, str]] = field(default_factory=dict)  # what a run comes to, as measured


@functools.cache
def roads(budget: str) -> Roads:
    """Return what a budget says of methods and tasks; nothing, where it has no file."""
    path = CONF_DIR / "roads" / f"{budget}.yaml"
    return Roads(**yaml.safe_load(path.read_text(encoding="utf-8"))) if path.is_file() else Roads()


def road(budget: str, method: str, env: str) -> list[str]:
    """Return the overrides with which a budget does a method in an environment, or in another version of it."""
    by_env = roads(budget).overrides.get(method, {})
    return by_env.get(env) or by_env.get(env.rsplit("_v", 1)[0], [])
