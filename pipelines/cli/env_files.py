"""The file of a custom environment, checked before Hydra reads it, whose messages are about its own internals."""

import dataclasses
import functools
from pathlib import Path

import yaml  # type: ignore[import-untyped]
from omegaconf import OmegaConf

from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.env import EnvConfig
from pipelines.engine.digests import flat
from pipelines.errors import ConfigError, did_you_mean

PACKAGE = "# @package _global_"
ALGORITHM = "override /algo"  # the entry of its defaults that chooses one
EXAMPLE = "docs/own.md has one to copy"


def check_env_file(path: Path) -> None:
    """Raise ConfigError where a file that `env=` names cannot be one of an environment; names the line or the key."""
    text = path.read_text(encoding="utf-8")
    try:
        content = yaml.safe_load(text)
    except yaml.MarkedYAMLError as error:
        place = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(f"{path}{place}: this is no YAML: {error.problem}") from error
    if not isinstance(content, dict) or not isinstance(content.get("env"), dict):
        raise ConfigError(f"{path}: it has no settings below env:, such as name, task and id; {EXAMPLE}")
    if PACKAGE not in text:
        raise ConfigError(f"{path}: its first line has to be\n  {PACKAGE}")
    known = [field.name for field in dataclasses.fields(EnvConfig) if "omegaconf_ignore" not in field.metadata]
    env = content["env"]
    for key in env:
        if key not in known:
            raise ConfigError(f"{path}: env has no setting {key!r}.{did_you_mean(str(key), known)}")
    missing = [key for key in ("name", "task", "id") if key not in env]
    if missing:
        raise ConfigError(f"{path}: env.{missing[0]} is missing; {EXAMPLE}")
    shipped = CONF_DIR / "env" / f"{env['name']}.yaml"
    if shipped.is_file() and yaml.safe_load(shipped.read_text(encoding="utf-8")) != content:
        raise ConfigError(
            f"{path}: env.name={env['name']} is the name of an environment that ships with otr, whose results these "
            f"would be taken for; give it a name of its own, such as {_own_name(path)}"
        )
    tasks = _tasks()
    if env["task"] not in tasks:
        raise ConfigError(
            f"{path}: env.task={env['task']}: conf/budget has no such row; it is discrete for labels, continuous for "
            f"other actions, or one of {', '.join(task for task in tasks if task not in ('discrete', 'continuous'))}"
        )


@functools.cache
def _tasks() -> list[str]:
    return [str(task) for task in OmegaConf.load(CONF_DIR / "budget" / "standard.yaml").steps]


def _own_name(path: Path) -> str:
    return path.stem if not (CONF_DIR / "env" / path.name).is_file() else f"own_{path.stem}"


def settings_of_env_file(path: Path) -> dict[str, str]:
    """Return what an environment's file, or one that it builds on, sets besides: its algorithm, and settings by key."""
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    said: dict[str, str] = {}
    for entry in content.get("defaults", []):
        if isinstance(entry, str) and (base := path.parent / f"{entry}.yaml").is_file():
            said |= settings_of_env_file(base)
        elif ALGORITHM in entry:
            said["algo"] = str(entry[ALGORITHM])
    others = flat({key: value for key, value in content.items() if key not in ("defaults", "env")})
    return said | {key: str(value) for key, value in others.items()}
