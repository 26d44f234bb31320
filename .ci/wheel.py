"""The wheel has `pipelines` as `otr.pipelines`, with `conf` in it, so that it shadows no module of a user's.

Imports, and names of modules that are given as text, are rewritten in a copy. See docs/decisions/wheel.md.
"""

import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

NAMED = re.compile(r'((?:^|\n)[ \t]*(?:from|import) |")pipelines(?=[ ."])')


class WheelHook(BuildHookInterface):
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Map a rewritten copy into the wheel; an editable install has the checkout as it is."""
        if version == "editable":
            return
        self.copy = tempfile.TemporaryDirectory()  # removed with this hook
        for name, place in {"pipelines": "otr/pipelines", "conf": "otr/pipelines/conf"}.items():
            copy = Path(self.copy.name) / name
            shutil.copytree(Path(self.root) / name, copy, ignore=shutil.ignore_patterns("__pycache__"))
            build_data["force_include"][str(copy)] = place
            for file in copy.rglob("*.py"):
                file.write_text(NAMED.sub(r"\1otr.pipelines", file.read_text("utf-8")), "utf-8")
