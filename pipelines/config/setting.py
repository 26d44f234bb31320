"""What a setting may be and whether it decides what comes out: declared at the field, enforced and keyed from there.

    gamma: Annotated[float, Range(0, 1)]
    n_workers: Annotated[Count | None, EXECUTION] = None

`check_settings` refuses values outside the declared range; `keyed_settings` gives the settings that decide what comes
out, which are all that no marker leaves out.
"""

import dataclasses
import os
import re
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from otr.setting import AsBefore as AsBefore
from otr.setting import Count as Count
from otr.setting import NotNegative as NotNegative
from otr.setting import OneOf as OneOf
from otr.setting import Positive as Positive
from otr.setting import Range as Range
from otr.setting import Share as Share
from otr.setting import declared as declared
from otr.setting import problem
from pipelines.errors import ConfigError

LARGEST_SEED = 2**32 - 1


@dataclass(frozen=True)
class Text:
    """A free text that `pattern` matches; `remedy` says what to give where it does not."""

    pattern: str = ".*"
    remedy: str = ""

    def problem(self, value: Any) -> str | None:
        """Return what is wrong with a value, to be printed after it; None where nothing is."""
        if isinstance(value, str) and re.fullmatch(self.pattern, value, re.DOTALL):
            return None
        return f"{'' if value else ' is empty'}: {self.remedy}"


@dataclass(frozen=True, eq=False)  # EXECUTION is not DERIVED
class NotKeyed:
    """A setting that does not decide what comes out, or that another one determines."""


@dataclass(frozen=True)
class OnlyWhere:
    """A setting that only some methods read: keyed where the method's attribute of this name is true."""

    attribute: str


EXECUTION = NotKeyed()  # how something is done, and where
DERIVED = NotKeyed()  # worked out from settings that are keyed

Width = Annotated[int, Range(1, remedy="every layer needs at least 1 neuron")]
Seed = Annotated[int, Range(0, LARGEST_SEED)]
FreeText = Annotated[str, Text()]
Folder = Annotated[str, Text(".+", "give a folder, or leave it out (and OTR_RESULTS_DIR unset)"), EXECUTION]


def results_folder() -> str:
    """Return the default of `results_dir`."""
    return os.environ.get("OTR_RESULTS_DIR", "results")


def not_keyed(kind: type) -> tuple[str, ...]:
    """Return the fields of a configuration's class that do not decide what comes out."""
    return tuple(name for name, markers in declared(kind).items() if any(isinstance(m, NotKeyed) for m in markers))


def is_list(kind: type, name: str) -> bool:
    """Return whether the field `name` of a configuration's class is a list."""
    return any(get_origin(hint) is list for hint in _alternatives(get_type_hints(kind)[name]))


def is_text(kind: type, name: str) -> bool:
    """Return whether the field `name` of a configuration's class may be a text."""
    return str in _alternatives(get_type_hints(kind)[name])


def expected(kind: type, name: str) -> str:
    """Return in words what the field `name` of a configuration's class may be: "a whole number of at least 1"."""
    hint = get_type_hints(kind, include_extras=True)[name]
    return " or ".join(_in_words(each, declared(kind)[name]) for each in _alternatives(hint))


def check_settings(config: Any, prefix: str = "") -> None:
    """Raise ConfigError if a setting of a dataclass, or of one inside it, is not in its field's range."""
    for name in declared(config.__class__):
        value = getattr(config, name)
        if dataclasses.is_dataclass(value):
            check_settings(value, f"{prefix}{name}.")
        else:
            check_setting(config.__class__, name, value, f"{prefix}{name}")
    between = config.problem(prefix) if hasattr(config, "problem") else None
    if between:
        raise ConfigError(between)


def check_setting(kind: Any, name: str, value: Any, key: str) -> None:
    """Raise ConfigError if the field `name` of `kind` cannot have this value; `key` is what the message calls it."""
    wrong = problem(kind, name, value, key)
    if wrong:
        raise ConfigError(wrong)


def keyed_settings(config: Any, method: Any = None) -> dict[str, Any]:
    """Return a dataclass's settings that decide what comes out, as plain data; `OnlyWhere` asks the method."""
    kept = {}
    for name, markers in declared(config.__class__).items():
        value = getattr(config, name)
        if not any(_leaves_out(marker, value, method) for marker in markers):
            kept[name] = keyed_settings(value, method) if dataclasses.is_dataclass(value) else value
    return kept


def _leaves_out(marker: Any, value: Any, method: Any) -> bool:
    """Return whether a marker leaves a setting out of the keys."""
    match marker:
        case NotKeyed():
            return True
        case AsBefore(before):
            return bool(value == before)
        case OnlyWhere(attribute):
            return not getattr(method, attribute)
    return False


def _alternatives(hint: Any) -> list[Any]:
    """Return the types of which a value may have any, without their markers and None at the end."""
    if get_origin(hint) is Annotated:
        return _alternatives(get_args(hint)[0])
    parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    flat = [each for part in parts for each in (_alternatives(part) if part is not hint else [part])]
    return sorted(flat, key=lambda each: each is NoneType)


def _in_words(hint: Any, markers: tuple[Any, ...], *, plural: bool = False) -> str:
    """Return a type with what its markers allow in words."""
    options = next((marker.options for marker in markers if isinstance(marker, OneOf)), None)
    limits = next((marker.limits for marker in markers if isinstance(marker, Range)), "")
    if get_origin(hint) is list:
        (inner,) = _alternatives(get_args(hint)[0])
        return f"a list of {_in_words(inner, markers, plural=True)}, as [{_EXAMPLES.get(inner, 'a,b')}]"
    if get_origin(hint) is dict:
        return "values by name, as {a: 1}"
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return f"its settings one by one ({', '.join(f'.{name}=' for name in declared(hint))})"
    if hint is str and options:
        return f"{'values' if plural else 'one'} of {', '.join(options)}"
    words = {NoneType: "null", bool: "true or false", str: "text", int: "whole number", float: "number"}.get(
        hint, "value"
    )
    if hint in (int, float):
        return f"{words}s{limits}" if plural else f"a {words}{limits}"
    return f"{words}s" if plural else words


_EXAMPLES = {int: "8,8", float: "0.5,1"}
