"""Errors that a user can act on: the command line prints their message alone, without a traceback."""

import difflib
from collections.abc import Sequence


class PipelineError(Exception):
    """Something in the run cannot go on; the message says what, where and what to do."""


class ConfigError(PipelineError):
    """The request itself is wrong (unknown name, wrong type, value out of range); exit code 2."""


class MissingInputError(PipelineError):
    """A stage's input is not there; the message names the command that makes it."""


class OtherSettingsError(PipelineError):
    """The folder holds the same run made with other settings, which are never overwritten."""


class PolicyMismatchError(PipelineError):
    """Two forms of one policy chose different actions on a state; the message shows the state."""


def check_choice(key: str, value: str, known: Sequence[str]) -> None:
    """Raise ConfigError unless a setting is one of those that are known."""
    if value not in known:
        raise ConfigError(f"{key}={value}: there is no such {key}.{did_you_mean(value, known)}")


def did_you_mean(name: str, known: Sequence[str], unlisted: Sequence[str] = ()) -> str:
    """Return a question with the nearest of the known names, or all of them but the `unlisted`, which are too many."""
    near = difflib.get_close_matches(name, [*known, *unlisted], n=3, cutoff=0.5)
    near += [key for key in known if key.split(".")[-1] == name and key not in near]
    if near:
        return f" Did you mean {' or '.join(near)}?"
    return f" There are: {', '.join(known)}" if known else ""
