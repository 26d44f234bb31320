"""Where an artefact comes from: versions, git revision and command. Recorded next to it, never part of its key."""

import functools
import platform
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path

PACKAGES = ("otr", "torch", "stable-baselines3", "gymnasium", "mujoco", "box2d", "numpy", "scipy")


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of each package that a result depends on; missing ones are left out."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


@functools.cache
def git_revision() -> str | None:
    """Return the source's git revision, with `+changes` where tracked files differ from it; None outside a checkout.

    Files below `results` are what is made, not what makes it, and do not count.
    """
    revision = _git("rev-parse", "--short=12", "HEAD")
    changed = _git("status", "--porcelain", "--untracked-files=no", "--", ":/", ":(top,exclude)results")
    if not revision or changed is None:
        return None
    return f"{revision}+changes" if changed else revision


def _git(*arguments: str) -> str | None:
    """Return what git prints in this file's folder; None where it fails or is not there.

    It must write nothing there: on a full disk it would leave its lock, and block the checkout.
    """
    command = ["git", "--no-optional-locks", *arguments]
    try:
        done = subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def command_line() -> str:
    """Return the command that is running: the program's name without its path, and its arguments but results_dir."""
    arguments = [argument for argument in sys.argv[1:] if not argument.startswith("results_dir=")]
    return shlex.join([Path(sys.argv[0]).name, *arguments])
