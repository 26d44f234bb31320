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
    """Adds the rewritten copy to a wheel; an editable install has the checkout as it is."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the copy, and map it into the wheel."""
        self.copy = Path(tempfile.mkdtemp())
        if version == "editable":
            return
        for name, place in {"pipelines": "otr/pipelines", "conf": "otr/pipelines/conf"}.items():
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(Path(self.root) / name, self.copy / name, ignore=ignored)
            build_data["force_include"][str(self.copy / name)] = place
        for file in (self.copy / "pipelines").rglob("*.py"):
            file.write_text(NAMED.sub(r"\1otr.pipelines", file.read_text("utf-8")), "utf-8")

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the copy."""
        shutil.rmtree(self.copy)
