"""The settings of commands that compose nothing: export, verify, report and tabulate."""

from collections.abc import Sequence
from typing import Any

from omegaconf import OmegaConf

from pipelines.cli.compose import one_value, schema_of, to_object
from pipelines.config.setting import declared, is_list, is_text
from pipelines.errors import ConfigError, did_you_mean


def settings_of(kind: Any, overrides: Sequence[str]) -> Any:
    """Return the settings of a command, a dataclass of this kind, from its overrides.

    Texts are as they are written, other values as Hydra reads them. A list is in brackets, or its key is given several
    times.
    """
    given: dict[str, Any] = {}
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals:
            raise ConfigError(f"{override} is no key=value; --help lists the settings")
        if key not in declared(kind):
            raise ConfigError(f"there is no key {key!r}.{did_you_mean(key, [*declared(kind)])}")
        if text == "null":
            given[key] = None
        elif is_list(kind, key):
            texts = text[1:-1].split(",") if text[:1] == "[" else [text]
            given[key] = [*(given.get(key) or []), *(_unquoted(each.strip()) for each in texts if each.strip())]
        else:
            given[key] = _unquoted(text) if is_text(kind, key) else one_value(override).value()
    return to_object(OmegaConf.merge(schema_of(kind), given))


def _unquoted(text: str) -> str:
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'" else text
