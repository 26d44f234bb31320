"""Configurations from words: Hydra's composition and sweep syntax, with messages for people."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from pipelines.cli.messages import readable
from pipelines.config.conf_dir import CONF_DIR
from pipelines.engine.sweep import check_launcher, quoted
from pipelines.errors import ConfigError, did_you_mean


@dataclass(frozen=True)
class Composer:
    """What one command's words are composed from.

    Attributes:
        name: of the main configuration file.
        folder: below conf/, where that file and the command's own groups lie; "" for conf/ itself. What is not there is
            looked for in conf/.
        groups: the groups whose options are checked.
        needs: the group of which an option must be named; None if there is none.
        anything: an option of that group, for where it does not matter which.
        schemas: what is registered for the configuration files to build on: (group, name) to dataclass.
        implied: from the words to further ones that they imply, which stand before them.
        shorthand: from a job's words to those that they are short for.
        short: the keys of such words.
    """

    name: str
    folder: str = ""
    groups: tuple[str, ...] = ()
    needs: str | None = None
    anything: str = ""
    schemas: dict[tuple[str | None, str], type] = dataclasses.field(default_factory=dict)
    implied: Callable[[Sequence[str]], list[str]] = lambda overrides: []
    shorthand: Callable[[Sequence[str]], list[str]] = list
    short: tuple[str, ...] = ()

    def register(self) -> None:
        """Tell Hydra the schemas."""
        store = ConfigStore.instance()
        for (group, name), schema in self.schemas.items():
            store.store(name, schema_of(schema), group=group)

    def compose(self, overrides: Sequence[str]) -> DictConfig:
        """Return the composed configuration; unknown names come back with the nearest known ones.

        Raises:
            ConfigError: a word is wrong, or one is missing.
        """
        for word in overrides:
            parse(word)
            key, _, value = word.lstrip("+").partition("=")
            if word.startswith("+") and not key.startswith(("experiment", "env.kwargs.", "hydra.")):
                raise ConfigError(f"{word}: new keys cannot be added; leave out the +")
            if key in self.groups:
                self.check_option(key, value)
            if key == "launcher":
                check_launcher(value)
        if self.needs and not any(word.lstrip("+").startswith(f"{self.needs}=") for word in overrides):
            what = {"env": "environment", "data": "data set"}[self.needs]
            raise ConfigError(f"which {what}? Add {self.needs}=NAME with one of: {', '.join(self.options(self.needs))}")
        with self.hydra():
            try:
                return compose(self.name, [*self._search_path(), *self.implied(overrides), *overrides])
            except HydraException as error:
                raise ConfigError(self._explain(error, overrides)) from error

    def expand(self, overrides: list[str], multirun: bool) -> list[list[str]]:
        """Return the overrides of every job that the words ask for, as Hydra's sweeper would make them."""
        is_sweep, parameters = self.sweep_parameters(overrides, multirun)
        if not is_sweep:
            return [self._spelt_out(overrides)]
        parsed = [parse(word) for word in (*parameters, *overrides)]
        return [self._spelt_out(job) for job in BasicSweeper.split_arguments(parsed, None)[0]]

    def _spelt_out(self, overrides: Sequence[str]) -> list[str]:
        """Return the words with `column=NAME` replaced by those that it stands for (conf/column.yaml), and so on."""
        overrides, path = self.shorthand(overrides), CONF_DIR / self.folder / "column.yaml"
        if not path.is_file():
            return list(overrides)
        columns: dict[str, str] = {str(name): stands_for for name, stands_for in OmegaConf.load(path).items()}
        words: list[str] = []
        for word in overrides:
            name = word.removeprefix("column=")
            if name != word and name not in columns:
                raise ConfigError(f"{word}: there is no such column.{did_you_mean(name, list(columns))}")
            words += [word] if name == word else columns[name].split()
        return words

    def sweep_parameters(self, overrides: list[str], multirun: bool) -> tuple[bool, list[str]]:
        """Return whether the words ask for a sweep, and the sweep parameters that an experiment brings.

        What conf/experiment/<name>/<budget>.yaml has comes on top of the experiment's own, so that a budget may sweep
        less.
        """
        parsed = [parse(word) for word in overrides]
        single = [word for word, override in zip(overrides, parsed, strict=True) if not override.is_sweep_override()]
        swept = [override.get_key_element() for override in parsed if override.is_sweep_override()]
        if swept and not multirun and not any(word.startswith("+experiment=") for word in overrides):
            raise ConfigError(f"{', '.join(swept)}: several values make a sweep; add -m")
        if any(key.lstrip("+") == "experiment" for key in swept):
            raise ConfigError("experiment: one at a time; start a command for each")
        experiments = [word for word in single if word.lstrip("+").startswith("experiment=")]
        if not experiments:
            return multirun, []
        budgets = [word for word in single if word.startswith("budget=") and "budget" in self.groups]
        for word in (*experiments, *budgets):
            self.check_option(*word.lstrip("+").split("=", 1))
        settings = self._settings_of_hydra([*budgets, *experiments])
        name, budget = experiments[-1].split("=", 1)[1], settings.runtime.choices.get("budget")
        if (CONF_DIR / self.folder / "experiment" / name / f"{budget}.yaml").is_file():
            settings = self._settings_of_hydra([*budgets, *experiments, f"+experiment/{name}={budget}"])
        parameters = [f"{key}={value}" for key, value in (settings.sweeper.params or {}).items()]
        return multirun or str(settings.mode).endswith("MULTIRUN"), parameters

    def _settings_of_hydra(self, overrides: Sequence[str]) -> DictConfig:
        """Return Hydra's own settings under these words, for whatever environment or data set."""
        with self.hydra():
            words = [*self._search_path(), f"{self.needs}={self.anything}", *overrides]
            settings = compose(self.name, words, return_hydra_config=True).hydra
        assert isinstance(settings, DictConfig)
        return settings

    def sweep_words(self, overrides: Sequence[str]) -> list[str]:
        """Return overrides for Hydra's own composition, where it launches a sweep."""
        return [*self._search_path(), *overrides]

    def check_option(self, group: str, value: str) -> None:
        """Raise ConfigError, with the nearest known names, if a group has no such option."""
        options = self.options(group)
        if value not in (*options, "null"):
            raise ConfigError(f"{group}={value}: there is no such {group}.{did_you_mean(value, options)}")

    def options(self, group: str) -> list[str]:
        """Return the names of a group's options."""
        own = sorted(path.stem for path in (CONF_DIR / self.folder / group).glob("*.yaml"))
        return own or sorted(path.stem for path in (CONF_DIR / group).glob("*.yaml"))

    @contextmanager
    def hydra(self) -> Iterator[None]:
        """Make Hydra ready to compose from conf/, also inside a job that Hydra itself has started."""
        instance = GlobalHydra.instance()
        outer, instance.hydra = instance.hydra, None
        try:
            folder = (CONF_DIR / self.folder).resolve()
            with initialize_config_dir(str(folder), job_name="otr", version_base="1.3"):
                yield
        finally:
            GlobalHydra.instance().hydra = outer

    def _search_path(self) -> list[str]:
        return [f"hydra.searchpath=[{quoted(f'file://{CONF_DIR.resolve()}')}]"] if self.folder else []

    def _explain(self, error: HydraException, overrides: Sequence[str]) -> str:
        """Return Hydra's message without its advice on `+`, with the nearest known key."""
        cause = error.__cause__
        lines = str(cause or error).splitlines()
        if "Could not override" in str(error):
            key = str(error).split("'")[1]
            base = [word for word in overrides if word.split("=")[0] in self.groups and "experiment=" not in word]
            keys = _leaves(OmegaConf.to_container(compose(self.name, [*self._search_path(), *base])))
            known = [*keys, *self.short]
            lines = [f"there is no key {key!r}.{did_you_mean(key, known)}"]
        return readable("\n".join(lines))


def parse(word: str) -> Override:
    """Return a word as Hydra reads it.

    Raises:
        ConfigError: it is no key=value.
    """
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException as error:
        raise ConfigError(f"{word} is no key=value: {str(error).splitlines()[0]}") from error


def to_object(cfg: Any) -> Any:
    """Return a configuration as the dataclass that is its schema.

    Raises:
        ConfigError: a value is missing, or the dataclass refuses one.
    """
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
