"""Entry points of the commands: their code is `pipelines` in a checkout, and `otr.pipelines` in a wheel."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any


def __getattr__(name: str) -> Any:
    return getattr(import_module("otr.pipelines.cli" if find_spec("otr.pipelines") else "pipelines.cli"), name)
