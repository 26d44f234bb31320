"""Packages that come with an extra of otr: loaded when they are first asked for, and named where they are missing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import import_module
from typing import Any

from otr.errors import MissingExtraError

# A package as it is imported: its name for pip, and the extra of otr that installs it.
_EXTRAS = {
    "huggingface_hub": ("huggingface_hub", "hub"),
    "joblib": ("joblib", "learn"),
    "matplotlib": ("matplotlib", "plots"),
    "onnx": ("onnx", "onnx"),
    "onnxruntime": ("onnxruntime", "onnx"),
    "skops": ("skops", "learn"),
    "sklearn": ("scikit-learn", "learn"),
    "torch": ("torch", "learn"),
    "hydra": ("hydra-core", "run"),
    "stable_baselines3": ("stable-baselines3", "run"),
} | {name: (name, "run") for name in ("filelock", "gymnasium", "omegaconf", "pandas", "rich", "safetensors")}


@contextmanager
def naming_the_extra(feature: str) -> Iterator[None]:
    """Raise MissingExtraError, which says that `feature` needs an extra, in place of its package's ImportError."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _EXTRAS:
            raise
        distribution, extra = _EXTRAS[package]
        message = f"{feature} needs {distribution}, which is not installed: pip install 'otr[{extra}]'"
        raise MissingExtraError(message, name=error.name) from error


def lazy_exports(
    package: str, modules: Mapping[str, str], subpackages: Sequence[str] = ()
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package.

    Its `subpackages`, and the `modules` of its names, are loaded when they are first used.
    """

    def load(name: str) -> Any:
        if name in subpackages:
            return import_module(f"{package}.{name}")  # which makes it an attribute of the package
        if name not in modules:
            near = get_close_matches(name, [*modules, *subpackages], n=1)
            instead = f"; did you mean {near[0]}?" if near else ""
            raise AttributeError(f"module {package!r} has no attribute {name!r}{instead}")
        with naming_the_extra(f"{package}.{name}"):
            value = getattr(import_module(f"{package}.{modules[name]}"), name)
        vars(sys.modules[package])[name] = value  # later uses find it there
        return value

    def names() -> list[str]:
        own = (name for name in vars(sys.modules[package]) if name.startswith("__"))  # not what the package imports
        return sorted({*own, *modules, *subpackages})

    return load, names
