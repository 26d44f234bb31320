"""The environment of a run: a file of conf/env, or one that is registered with gymnasium."""

import ast
import functools
import hashlib
import importlib.util
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import yaml  # type: ignore[import-untyped]

from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.setting import DERIVED, FreeText


@dataclass(frozen=True)
class PidTerms:
    """What a PID policy observes: [s, P, I, D] in place of the state s (`otr.control.pid_observation`)."""

    goal: tuple[float, ...]  # e, one number a component of the state
    n_history: int  # states before s that I sums over


@dataclass(frozen=True)
class EnvConfig:
    """One environment: its gymnasium id and the names that programs print.

    `pid` is set for PID policies, whose environments show [s, P, I, D].
    """

    name: FreeText
    # The row of the tables and of conf/budget; hopper_v5 has task hopper, a custom one has task discrete or continuous
    task: FreeText
    id: FreeText
    kwargs: dict[str, Any] = field(default_factory=dict)
    feature_names: list[FreeText] = field(default_factory=list)
    action_names: list[FreeText] = field(default_factory=list)
    pid: Annotated[PidTerms | None, DERIVED] = field(default=None, metadata={"omegaconf_ignore": True})

    def settings(self) -> dict[str, Any]:
        """Return what decides how the environment behaves, for the keys of stages that play in it.

        Of `module:Id` that is the module's code, too.
        """
        pid = {} if self.pid is None else {"pid": {"goal": list(self.pid.goal), "n_history": self.pid.n_history}}
        module = self.id.rpartition(":")[0]
        code = {"code_sha256": _code_sha256(module)} if module else {}
        return {"id": self.id, "kwargs": self.kwargs, **pid, **code}

    @property
    def has_file(self) -> bool:
        """Whether the environment is one of conf/env."""
        return _names_in_conf(self.name) is not None

    def own_names(self) -> dict[str, Any]:
        """Return the names of features and actions for the keys of stages that print them; none if conf's."""
        names = {"feature_names": list(self.feature_names), "action_names": list(self.action_names)}
        return {} if names == _names_in_conf(self.name) else names


def search_here() -> None:
    """Let modules be imported from the folder in which the command was started, after the installed ones."""
    here = str(Path.cwd())
    if here not in sys.path:  # a command's own path begins with the folder of the command
        sys.path.append(here)


@functools.cache
def _code_sha256(module: str) -> str | None:
    """Return the digest of a module's own code (`_code_files`); None where there is no such module or file."""
    search_here()
    spec = importlib.util.find_spec(module.partition(".")[0])
    if spec is None:
        return None
    # The folders of a package, whether it has an __init__.py or not, or a module's file
    places = [*(spec.submodule_search_locations or ([spec.origin] if spec.origin else []))]
    files = _code_files([Path(place) for place in places if Path(place).exists()])
    if not files:
        return None
    return hashlib.sha256(b"".join(hashlib.sha256(each.read_bytes()).digest() for each in files)).hexdigest()


def _code_files(places: Sequence[Path]) -> list[Path]:
    """Return the Python files of a module, a file or a package's folders, and those next to it that it names.

    It names what it imports, and what it registers as "module:Name". Of an installed package, which has every
    other one next to it, these are its own files alone. The versions of stages identify this library's code.
    """
    found, left = dict[Path, None](), list(places)
    while left:
        place = left.pop()
        own = sorted(place.rglob("*.py")) if place.is_dir() else [place]
        found |= dict.fromkeys(own)
        if place.parent.name in ("site-packages", "dist-packages"):
            continue
        for name in sorted({name for each in own for name in _named(each)} - {"otr", "pipelines"}):
            package, file = place.parent / name, place.parent / f"{name}.py"
            if package.is_dir():
                left += [package] if any(each not in found for each in package.rglob("*.py")) else []
            elif file.is_file() and file not in found:
                left.append(file)
    return list(found)


def _named(file: Path) -> set[str]:
    """Return the first parts of the names of modules that a file imports, or names in text as "module:Name"."""
    try:
        nodes = list(ast.walk(ast.parse(file.read_bytes())))
    except (SyntaxError, ValueError):  # making the environment reports it
        return set()
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module and not node.level}
    texts = (node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str))
    names |= {text.partition(":")[0] for text in texts if re.fullmatch(r"[^\W\d][\w.]*:[^\W\d]\w*", text)}
    return {name.partition(".")[0] for name in names}


@functools.cache
def _names_in_conf(name: str) -> dict[str, Any] | None:
    path = CONF_DIR / "env" / f"{name}.yaml"
    if not path.is_file():
        return None
    file = yaml.safe_load(path.read_text(encoding="utf-8"))
    base = file["defaults"][0]  # of hopper_v5 that is hopper
    inherited = (_names_in_conf(base) if isinstance(base, str) else None) or {}
    return {key: file["env"].get(key, inherited.get(key, [])) for key in ("feature_names", "action_names")}
