"""Errors that a user can act on: the command line prints their message alone, without a traceback."""

import difflib
import re
from collections.abc import Sequence

NEAR = 0.5  # the least likeness of a name that may be meant


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
    likeness = {key: _likeness(name, key) for key in (*known, *unlisted)}
    near = sorted(likeness, key=lambda key: (*likeness[key], key), reverse=True)[:3]
    near = [key for key in near if likeness[key][0] >= NEAR]
    near += [key for key in known if key.split(".")[-1] == name and key not in near]
    if near:
        return f" Did you mean {' or '.join(near)}?"
    return f" There are: {', '.join(known)}" if known else ""


def _likeness(name: str, other: str) -> tuple[float, float]:
    """Return how alike two names are, without version (-v5) and case, and letter by letter."""
    plain, other_plain = (re.sub(r"-v\d+$", "", each.lower()) for each in (name, other))
    return (
        difflib.SequenceMatcher(None, other_plain, plain).ratio(),
        difflib.SequenceMatcher(None, other, name).ratio(),
    )
