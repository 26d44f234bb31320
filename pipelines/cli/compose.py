"""Configurations from overrides: Hydra's composition, with messages for people."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pipelines.cli.overrides import is_search, key_of, parse, quoted, searched_folders
from pipelines.config.conf_dir import CONF_DIR
from pipelines.engine.job import message_of as message_of_job
from pipelines.engine.sweep import check_launcher
from pipelines.errors import ConfigError, did_you_mean

USAGE_ERRORS = (ConfigError, HydraException, OmegaConfBaseException)  # the request itself is wrong
NEW_KEYS = ("experiment", "env.kwargs.", "hydra.")  # what a + may add


class Composer:
    """What one command's overrides are composed from.

    `name` is that of the main configuration file, `schemas` are the dataclasses that the files build on, by group and
    name, and `checked` the groups whose options are checked.
    """

    # Where that file and the command's own groups lie, below conf/; what is not there is looked for in conf/ itself.
    folder = ""
    needs: tuple[str, str] | None = None  # the group of which an option must be named, and what such an option is
    short: tuple[str, ...] = ()  # keys of overrides that stand for others (`Workflow.spelt_out`)
    # Keys of single values. Overrides that differ in these alone are composed once, and the values put in.
    varied: tuple[str, ...] = ()

    def __init__(
        self, name: str, schemas: Mapping[tuple[str | None, str], type], checked: tuple[str, ...] = ()
    ) -> None:
        self.name, self.schemas, self.checked = name, schemas, checked
        self._composed: dict[tuple[str, ...], DictConfig] = {}
        self._is_registered = False

    def implied(self, overrides: Sequence[str]) -> list[str]:
        """Return the overrides that these imply, which stand before them."""
        return []

    def compose(self, overrides: Sequence[str]) -> DictConfig:
        """Return the composed configuration; ConfigError names the override that is wrong or missing."""
        values = [override for override in overrides if override.partition("=")[0] in self.varied]
        others = [override for override in overrides if override not in values]
        found = tuple(sorted(others))
        if found not in self._composed:
            self._composed[found] = self._compose(others)
        cfg = copy.deepcopy(self._composed[found])
        for override in values:
            OmegaConf.update(cfg, key_of(override), parse(override).value(), merge=True)
        return cfg

    def _compose(self, overrides: Sequence[str]) -> DictConfig:
        return self._compose_exactly([*self.implied(overrides), *overrides])

    def _compose_exactly(self, overrides: Sequence[str]) -> DictConfig:
        """Compose these overrides without what they imply."""
        for override in overrides:
            parse(override)
            key, _, value = override.lstrip("+").partition("=")
            if override.startswith("+") and not key.startswith(NEW_KEYS):
                raise ConfigError(f"{override}: new keys cannot be added; leave out the +")
            if key in self.checked:
                self.check_option(key, value, overrides)
            if key == "launcher":
                check_launcher(value)
        if self.needs and self.needs[0] not in map(key_of, overrides):
            group, what = self.needs
            raise ConfigError(f"which {what}? Add {group}=NAME with one of: {', '.join(self.options(group))}")
        with self.hydra():
            try:
                return compose(self.name, [*self._search_path(), *overrides])
            except HydraException as error:
                raise ConfigError(self._explain(error, overrides)) from error

    def settings_of_hydra(self, overrides: Sequence[str]) -> DictConfig:
        """Return Hydra's own settings under these overrides."""
        with self.hydra():
            cfg = compose(self.name, [*self._search_path(), *overrides], return_hydra_config=True)
        settings: DictConfig = cfg.hydra
        return settings

    def launch(self, tasks: Sequence[Any], overrides: Sequence[str]) -> list[Any]:
        """Return what tasks return (see `hydra_plugins/otr_sweeper.py`), under the launcher that the overrides name."""
        with self.hydra():
            hydra: Any = GlobalHydra.instance().hydra
            asked = [*self._search_path(), *overrides]
            returned: list[Any] = hydra.multirun(self.name, tasks, asked, with_log_configuration=False)
        return returned

    def check_option(self, group: str, value: str, overrides: Sequence[str] = ()) -> None:
        """Raise ConfigError, with the nearest known names, if a group has no such option under these overrides."""
        options = self.options(group, overrides)
        if value not in (*options, "null"):
            raise ConfigError(f"{group}={value}: there is no such {group}.{did_you_mean(value, options)}")

    def options(self, group: str, overrides: Sequence[str] = ()) -> list[str]:
        """Return the names of a group's options: its files in conf/, and in the folders that the overrides search."""
        own = sorted(path.stem for path in (CONF_DIR / self.folder / group).glob("*.yaml"))
        shipped = own or sorted(path.stem for path in (CONF_DIR / group).glob("*.yaml"))
        searched = (path.stem for folder in searched_folders(overrides) for path in (folder / group).glob("*.yaml"))
        return [*shipped, *sorted(set(searched) - set(shipped))]

    @contextmanager
    def hydra(self) -> Iterator[None]:
        """Make Hydra ready to compose from conf/."""
        with initialize_config_dir(str((CONF_DIR / self.folder).resolve()), job_name="otr", version_base="1.3"):
            if not self._is_registered:
                for (group, name), schema in self.schemas.items():
                    ConfigStore.instance().store(name, schema_of(schema), group=group)
                self._is_registered = True
            yield

    def _search_path(self) -> list[str]:
        return [f"hydra.searchpath=[{quoted(f'file://{CONF_DIR.resolve()}')}]"] if self.folder else []

    def _explain(self, error: HydraException, overrides: Sequence[str]) -> str:
        """Return Hydra's message without its advice on `+`, with the nearest known key."""
        cause = error.__cause__
        lines = str(cause or error).splitlines()
        if "Could not override" in str(error):
            key = str(error).split("'")[1]
            base = [
                override
                for override in overrides
                if (override.split("=")[0] in self.checked and "experiment=" not in override) or is_search(override)
            ]
            keys = _leaves(OmegaConf.to_container(compose(self.name, [*self._search_path(), *base])))
            known = [*keys, *self.short]
            lines = [f"there is no key {key!r}.{did_you_mean(key, known)}"]
        return readable("\n".join(lines))


def message_of(error: Exception) -> str:
    """Return the message alone where it was written for people, with the error's kind where it was not."""
    if isinstance(error, OmegaConfBaseException):
        return readable(str(error))
    return str(error) if isinstance(error, HydraException) else message_of_job(error)


def readable(message: str) -> str:
    """Return OmegaConf's message in one line that begins with the key."""
    lines = [line.strip() for line in message.splitlines() if line.strip() and "_type=" not in line]
    keys = [line.removeprefix("full_key: ") for line in lines if line.startswith("full_key: ")]
    rest = "\n".join(line for line in lines if not line.startswith("full_key: "))
    return f"{keys[0]}: {rest}" if keys else rest


def to_object(cfg: Any) -> Any:
    """Return a configuration as the dataclass that is its schema; ConfigError where a value is missing or refused."""
    missing = OmegaConf.missing_keys(cfg)
    if missing:
        raise ConfigError(f"no value for {', '.join(sorted(missing))}")
    return OmegaConf.to_object(cfg)


def schema_of(kind: type) -> DictConfig:
    """Return a dataclass as a schema to merge into: OmegaConf makes frozen ones read-only, which is undone here."""
    schema: DictConfig = OmegaConf.structured(kind)
    for node in (schema, *(schema._get_node(key) for key in schema)):
        if isinstance(node, DictConfig):
            OmegaConf.set_readonly(node, None)
    return schema


def _leaves(value: Any, prefix: str = "") -> list[str]:
    if not isinstance(value, dict):
        return [prefix.rstrip(".")]
    return [prefix.rstrip(".")] * bool(prefix) + [
        leaf for key in value for leaf in _leaves(value[key], f"{prefix}{key}.")
    ]
