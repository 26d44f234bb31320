"""Commands that messages suggest, as a shell reads them."""

import shlex
from collections.abc import Sequence
from pathlib import Path


def command_text(program: str, overrides: Sequence[str], results_dir: Path | str | None = None) -> str:
    """Return a command, with the folder of results where that is not `results`, the default."""
    return shlex.join([program, *overrides, *([] if results_dir is None else place_of(results_dir))])


def place_of(results_dir: Path | str) -> list[str]:
    """Return the override that names a folder of results; none for `results`, the default."""
    place, here = Path(results_dir).absolute(), Path.cwd()
    if place == here / "results":
        return []
    return [f"results_dir={place.relative_to(here) if place.is_relative_to(here) else place}"]
