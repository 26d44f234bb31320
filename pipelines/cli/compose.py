"""Configurations from overrides: Hydra's composition, with clearer messages."""

import copy
import dataclasses
import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, get_type_hints

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import AnyNode, DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException, ValidationError

from pipelines.cli.launching import launch
from pipelines.cli.overrides import key_of, parse, quoted
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.setting import DERIVED, declared, expected, is_list
from pipelines.engine.job import message_of as message_of_job
from pipelines.engine.sweep import check_launcher
from pipelines.errors import ConfigError, did_you_mean

USAGE_ERRORS = (ConfigError, HydraException, OmegaConfBaseException)  # the request itself is wrong
SCHEMA = "_schema"
NEW_KEYS = ("experiment", "env.kwargs.", "hydra.")  # what a + may add


class Composer:
    """What one command's overrides are composed from.

    `name` is that of the main configuration file, `schemas` are the dataclasses that the files build on, as
    `<name>_schema`, or that are options themselves, by group and name, and `checked` the groups whose options are
    checked.
    """

    # Where that file and the command's own groups are, below conf/; what is missing is looked for in conf/ itself.
    folder = ""
    needs: tuple[str, str]  # the group of which an option is required, and what such an option is
    besides = ""  # what else may be named, in words
    short: tuple[str, ...] = ()  # keys of overrides that stand for others (`Workflow.spelt_out`)
    # Beginnings of keys of values that decide what is composed, as the options of a group do.
    decisive: tuple[str, ...] = ()

    def __init__(
        self, name: str, schemas: Mapping[tuple[str | None, str], type], checked: tuple[str, ...] = ()
    ) -> None:
        self.name, self.schemas, self.checked = name, schemas, checked
        self._composed: dict[tuple[str, ...], DictConfig] = {}
        self._is_registered = False

    @functools.cached_property
    def _lists(self) -> frozenset[str]:
        """Keys of settings that are lists, in whatever option of a group."""
        return frozenset(
            f"{prefix}{key}"
            for (group, _), kind in self.schemas.items()
            for prefix in ([f"{group}."] if group else [""])
            for key in _lists_of(kind)
        )

    def takes_list(self, override: str) -> bool:
        """Return whether the value of an override is to be a list."""
        return key_of(override) in self._lists

    def with_list(self, override: str) -> str:
        """Return an override with brackets around a single value where a list is to be: oracle=256 is oracle=[256]."""
        if not self.takes_list(override):
            return override
        parsed = parse(override)
        if parsed.is_sweep_override() or parsed.value() is None or isinstance(parsed.value(), list):
            return override
        key, _, value = override.partition("=")
        return f"{key}=[{value}]"

    def parsed(self, override: str) -> Override:
        """Return an override as Hydra reads it; ConfigError, with the key that is likely meant, where it is none."""
        if "=" in override:
            return parse(override)
        of_name = [f"{group}={override}" for group in self.checked if override in self.options(group)]
        if of_name:
            raise ConfigError(f"{override} is no key=value. Did you mean {' or '.join(of_name)}?")
        example = f"{self.needs[0]}={self.options(self.needs[0])[0]}"
        raise ConfigError(f"{override} is no key=value; settings are given as {example}, and --help lists them")

    def implied(self, overrides: Sequence[str]) -> list[str]:
        """Return the overrides that these imply, which come before them."""
        return []

    def compose(self, overrides: Sequence[str]) -> DictConfig:
        """Return the composed configuration; ConfigError names the override that is wrong or missing.

        Hydra composes each choice of options once. Values are put into a copy, as Hydra puts them.
        """
        overrides = [self.with_list(override) for override in overrides]
        values = [override for override in overrides if self.is_value(override)]
        others = [override for override in overrides if override not in values]
        found = tuple(sorted(others))
        if found not in self._composed:
            self._composed[found] = self._compose(others)
        cfg = copy.deepcopy(self._composed[found])
        try:
            for override in values:
                OmegaConf.update(cfg, key_of(override), parse(override).value(), merge=True)
        except (ConfigAttributeError, ConfigKeyError):
            return self._compose(overrides)  # which explains that there is no such key
        return cfg

    def is_value(self, override: str) -> bool:
        """Return whether an override sets a value, and decides nothing of what else there is."""
        key, equals, _ = override.partition("=")
        top = key.partition(".")[0]
        is_setting = top in self._settings and key not in self.checked and not key.startswith(self.decisive)
        return bool(equals) and is_setting and not parse(override).is_sweep_override()

    @functools.cached_property
    def _settings(self) -> frozenset[str]:
        """The keys at the top of the main configuration, without what is worked out from others."""
        fields = declared(self.schemas[None, f"{self.name}_schema"])
        return frozenset(key for key, markers in fields.items() if DERIVED not in markers)

    def _compose(self, overrides: Sequence[str]) -> DictConfig:
        return self._compose_exactly([*self.implied(overrides), *overrides])

    def _compose_exactly(self, overrides: Sequence[str]) -> DictConfig:
        """Compose these overrides without what they imply."""
        for override in overrides:
            one_value(override, self.parsed(override))
            key, _, value = override.lstrip("+").partition("=")
            if override.startswith("+") and not key.startswith(NEW_KEYS):
                raise ConfigError(f"{override}: new keys cannot be added; leave out the +")
            if key in self.checked:
                self.check_option(key, value)
            if key == "launcher":
                check_launcher(value)
        if self.needs[0] not in map(key_of, overrides):
            implied = self.implied(overrides)
            self.check_keys([override for override in overrides if override not in implied])
            group, what = self.needs
            raise ConfigError(
                f"which {what}? Add {group}=NAME with one of: {', '.join(self.options(group))}{self.besides}"
            )
        with self.hydra():
            try:
                return compose(self.name, [*self._search_path(), *overrides])
            except HydraException as error:
                raise ConfigError(self._explain(error, overrides)) from error

    def check_keys(self, overrides: Sequence[str], others: Sequence[str] = ()) -> None:
        """Raise ConfigError where an override's key begins as none of this command's, or of these others."""
        known = [*others, *sorted({*self._settings, *self.checked, *self.short})]
        for override in overrides:
            top = re.split(r"[./]", key_of(override))[0]
            if top not in (*known, "hydra"):
                raise ConfigError(f"there is no key {key_of(override)!r}.{did_you_mean(top, known)}")

    def settings_of_hydra(self, overrides: Sequence[str]) -> DictConfig:
        """Return Hydra's own settings under these overrides."""
        with self.hydra():
            cfg = compose(self.name, [*self._search_path(), *overrides], return_hydra_config=True)
        settings: DictConfig = cfg.hydra
        return settings

    def launch(self, tasks: Sequence[Any], overrides: Sequence[str]) -> list[Any]:
        """Return what tasks return, under the launcher that the overrides name."""
        asked = [*self._search_path(), *map(self.with_list, [*self.implied(overrides), *overrides])]
        with self.hydra():
            return launch(tasks, compose(self.name, asked, return_hydra_config=True))

    def check_option(self, group: str, value: str) -> None:
        """Raise ConfigError, with the nearest known names, if a group has no such option."""
        options = self.options(group)
        if value not in options:
            raise ConfigError(f"{group}={value}: there is no such {group}.{did_you_mean(value, options)}")

    def options(self, group: str) -> list[str]:
        """Return the names of a group's options: its files in conf/, else the classes that are options themselves."""
        for folder in (CONF_DIR / self.folder / group, CONF_DIR / group):
            if files := sorted(path.stem for path in folder.glob("*.yaml")):
                return files
        return sorted(name for of, name in self.schemas if of == group and not name.endswith(SCHEMA))

    @contextmanager
    def hydra(self) -> Iterator[None]:
        """Make Hydra ready to compose from conf/."""
        with initialize_config_dir(str((CONF_DIR / self.folder).resolve()), job_name="otr", version_base="1.3"):
            if not self._is_registered:
                for (group, name), kind in self.schemas.items():
                    schema = schema_of(kind)
                    if not name.endswith(SCHEMA):
                        schema.name = name
                    ConfigStore.instance().store(name, schema, group=group)
                self._is_registered = True
            yield

    def _search_path(self) -> list[str]:
        return [f"hydra.searchpath=[{quoted(f'file://{CONF_DIR.resolve()}')}]"] if self.folder else []

    def _explain(self, error: HydraException, overrides: Sequence[str]) -> str:
        """Return Hydra's message without its advice on `+`, with the nearest known key."""
        cause = error.__cause__
        if isinstance(cause, ValidationError):
            return readable(cause)
        lines = str(cause or error).splitlines()
        if "Could not override" in str(error):
            key = str(error).split("'")[1]
            if key.startswith("env.kwargs."):
                given = next(override for override in overrides if key_of(override) == key)
                return f"env.kwargs has no {key.split('.')[2]!r} to change; to give it one: +{given}"
            if key.startswith("hydra.launcher."):
                launcher = next((override for override in overrides if key_of(override) == "launcher"), None)
                if launcher:
                    return f"{launcher} has no setting {key.removeprefix('hydra.launcher.')!r}"
                return f"{key}: no launcher was chosen that has it; add launcher=joblib, or another that does"
            base = [
                override
                for override in overrides
                if override.split("=")[0] in self.checked and "experiment=" not in override
            ]
            keys = _leaves(OmegaConf.to_container(compose(self.name, [*self._search_path(), *base])))
            known = [*keys, *self.short]
            return f"there is no key {key!r}.{did_you_mean(key, known)}"
        return _one_line(lines)


def one_value(override: str, parsed: Override | None = None) -> Override:
    """Return an override as Hydra reads it; ConfigError where it has several values."""
    parsed = parsed or parse(override)
    if parsed.is_sweep_override():
        raise ConfigError(f"{override}: give one value; a list is written in brackets, as [a,b]")
    return parsed


def message_of(error: Exception) -> str:
    """Return the message of an error of ours, and any other with the error's type."""
    if isinstance(error, OmegaConfBaseException):
        return readable(error)
    return str(error) if isinstance(error, HydraException) else message_of_job(error)


def readable(error: OmegaConfBaseException) -> str:
    """Return OmegaConf's refusal of a value as what the setting's declaration expects, other messages in one line."""
    node, key, full_key = error.parent_node, error.key, error.full_key
    if isinstance(error, ValidationError) and full_key:
        while node is not None and not _declares(node, key):  # a value within a list, or a dict
            node, key = node._get_parent(), node._key()
        kind = OmegaConf.get_type(node) if node is not None else None
        if kind is not None:
            value, wanted = "null" if error.value is None else error.value, expected(kind, str(key))
            whole = full_key.partition("[")[0]
            return f"{full_key}={value}: " + (f"give {wanted}" if whole == full_key else f"{whole} is {wanted}")
    return _one_line(str(error).splitlines())


def _declares(node: Any, key: Any) -> bool:
    """Return whether a node is a dataclass of settings with this key."""
    kind = OmegaConf.get_type(node)
    return dataclasses.is_dataclass(kind) and isinstance(kind, type) and key in declared(kind)


def _one_line(message: Sequence[str]) -> str:
    """Return the lines of a message in one that begins with the key."""
    lines = [line.strip() for line in message if line.strip() and "_type=" not in line]
    keys = [line.removeprefix("full_key: ") for line in lines if line.startswith("full_key: ")]
    rest = "\n".join(line for line in lines if not line.startswith("full_key:"))
    return f"{keys[0]}: {rest}" if keys else rest


def to_object(cfg: Any) -> Any:
    """Return a configuration as the dataclass that is its schema; ConfigError where a value is missing or refused."""
    missing = OmegaConf.missing_keys(cfg)
    if missing:
        raise ConfigError(f"no value for {', '.join(sorted(missing))}")
    return OmegaConf.to_object(cfg)


def schema_of(kind: type) -> DictConfig:
    """Return a dataclass as a schema to merge into.

    OmegaConf makes frozen ones read-only, which is undone here, and puts no mapping where a mapping is null, so that
    such a setting is of any type, which its dataclass checks.
    """
    schema: DictConfig = OmegaConf.structured(kind)
    _make_writable(schema)
    return schema


def _make_writable(schema: DictConfig) -> None:
    OmegaConf.set_readonly(schema, None)
    for key in schema:
        node = schema._get_node(key)
        if isinstance(node, DictConfig):
            if node._is_none():
                OmegaConf.set_readonly(node, None)
                schema.__dict__["_content"][key] = AnyNode(None, key=key, parent=schema)
            else:
                _make_writable(node)


def _lists_of(kind: type, prefix: str = "") -> Iterator[str]:
    """Yield the keys of a dataclass's settings that are lists, and of those inside it."""
    hints = get_type_hints(kind)
    for name in declared(kind):
        if is_list(kind, name):
            yield f"{prefix}{name}"
        elif dataclasses.is_dataclass(hints[name]):
            yield from _lists_of(hints[name], f"{prefix}{name}.")


def _leaves(value: Any, prefix: str = "") -> list[str]:
    if not isinstance(value, dict):
        return [prefix.rstrip(".")]
    return [prefix.rstrip(".")] * bool(prefix) + [
        leaf for key in value for leaf in _leaves(value[key], f"{prefix}{key}.")
    ]
