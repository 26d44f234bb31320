"""Hydra's overrides as text: how they are read and quoted, and which jobs a sweep over them has."""

import argparse
import functools
import itertools
import re
from collections.abc import Iterable
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException

from pipelines.config.stages import SIDE
from pipelines.errors import ConfigError

FILES = ("program", "model", "oracle", "normalise", "output", "results_dir", "data", "target")  # of otr-run and -fit
BOXES = ("box", "certification.box")


@functools.cache
def parse(override: str) -> Override:
    """Return an override as Hydra reads it; ConfigError where it is no key=value, or has infinitely many values."""
    key, equals, _ = override.partition("=")
    if not equals or not key or key.startswith("~"):
        raise ConfigError(f"{override} is no key=value")
    try:
        parsed = OverridesParser.create().parse_override(override)
    except HydraException as error:
        raise ConfigError(
            f"{override}: the value cannot be read; is a bracket or a quote open? Other signs go between quotes, "
            f"as \"{key}='...'\""
        ) from error
    if parsed.is_sweep_override() and (isinstance(parsed.value(), Glob) or not parsed.is_discrete_sweep()):
        raise ConfigError(f"{override}: give values, range() or choice(); glob() and interval() are not known here")
    return parsed


def key_of(override: str) -> str:
    """Return the key of an override, without the + of a new one."""
    return override.lstrip("+").partition("=")[0]


def is_of_launching(override: str) -> bool:
    """Return whether an override concerns how a sweep is launched, and no job."""
    return override.lstrip("+").startswith(("launcher=", "hydra.", "hydra/"))


def asked(arguments: argparse.Namespace) -> list[str]:
    """Return the overrides of a command, those of boxes and files as Hydra reads them."""
    return [with_path_quoted(box_spelt_out(with_home(override))) for override in arguments.overrides]


def without_environment(arguments: argparse.Namespace) -> tuple[list[str], list[str]]:
    """Return the overrides of a command of policies, and apart from them those that say more of its environment.

    These are names (`env.feature_names`) and arguments (`+env.kwargs.size`).
    """
    overrides = asked(arguments)
    of_env = [each for each in overrides if key_of(each).startswith("env.")]
    return [each for each in overrides if each not in of_env], of_env


def combinations(overrides: Iterable[str]) -> list[list[str]]:
    """Return the overrides of every job of a sweep: all combinations of the values, those of the last key fastest.

    A key that is given twice keeps its place and has the values that come last.
    """
    values: dict[str, list[str]] = {}
    for override in map(parse, overrides):
        key = override.get_key_element()
        if not override.is_sweep_override():
            values[key] = [f"{key}={override.get_value_element_as_str()}"]
        else:
            values[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
    return [list(job) for job in itertools.product(*values.values())]


def quoted(value: str) -> str:
    """Return a string as the value of a Hydra override."""
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return value if re.fullmatch("[A-Za-z0-9/._-]+", value) else f"'{escaped}'"


def with_home(override: str) -> str:
    """Return `key=~/PATH`, or several, with the home folder spelt out, as not every shell does after a `=`."""
    key, equals, value = override.partition("=")
    if not value.startswith("~/"):
        return override
    return key + equals + ",".join(str(Path(path).expanduser()) for path in value.split(","))


def with_path_quoted(override: str) -> str:
    """Return `program=PATH`, or several, quoted where Hydra would stumble: over a ~ of a run's folder, a space, an ü.

    So are the values of the other keys of FILES.
    """
    key, _, value = override.partition("=")
    if key not in FILES or re.fullmatch(r"[\w./,-]*", value, re.ASCII) or value[:1] in ("'", '"', "[") or "(" in value:
        return override
    return f"{key}={','.join(quoted(path) for path in value.split(','))}"


def box_spelt_out(override: str) -> str:
    """Return ``box=[angle in -0.2..0.2, ...]``, or ``box=FILE`` with a side a line, as a list that Hydra reads."""
    key, _, value = override.partition("=")
    if key not in BOXES or value in ("", "null") or "],[" in value:
        return override
    text = value if re.search(r"\sin\s", value) else _sides_in(Path(value.strip("'\"[]")), override)
    sides = [side.strip().strip("'\"") for side in re.split(r"[,\n]", text.strip().removeprefix("[").removesuffix("]"))]
    written = (re.sub(SIDE, lambda m: f"{m[1]} in {_number(m[2])}..{_number(m[3])}", side) for side in sides if side)
    return f"{key}=[{','.join(quoted(side) for side in written)}]"


def _sides_in(path: Path, override: str) -> str:
    """Return the sides that a file has, without comments."""
    try:
        return re.sub("#.*", "", path.expanduser().read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f'{override}: give sides, as box="[angle in -0.2..0.2, velocity in -1..1]", or a file with a side a line '
            f"({getattr(error, 'strerror', None) or 'it is no UTF-8 text'})"
        ) from error


def _number(text: str) -> str:
    return f"{float(text)!r}".removesuffix(".0")
