"""What `otr-run` and `otr-fit` share: from the overrides of a command to its jobs."""

import dataclasses
import functools
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pipelines.cli.compose import Composer, to_object
from pipelines.cli.overrides import combinations, is_of_launching, key_of, parse
from pipelines.config.conf_dir import CONF_DIR
from pipelines.engine.console import counted
from pipelines.engine.digests import setting_differences
from pipelines.engine.job import Job
from pipelines.errors import ConfigError


@dataclass(frozen=True)
class Composed:
    """A job's configuration: as a dataclass, and as the text of config.yaml."""

    config: Any
    yaml: str
    uses_seed: bool  # whether another seed may change another setting, so that it has to be composed again

    def with_seed(self, seed: int) -> "Composed":
        """Return the same with another seed."""
        yaml = re.sub(r"(?m)^seed: .*$", f"seed: {seed}", self.yaml, count=1)
        return dataclasses.replace(self, config=dataclasses.replace(self.config, seed=seed), yaml=yaml)


class Workflow(Composer, ABC):
    """A command that does jobs."""

    anything: str  # an option of the required group, where any will do
    naming: tuple[str, ...]  # keys of overrides that the folder of a job names
    harmless: tuple[str, ...]  # keys of overrides that do not decide what comes out of a job
    _made: dict[tuple[str, ...], Composed]  # of the requested jobs

    @abstractmethod
    def job(self, overrides: Sequence[str]) -> Job:
        """Return the job with these overrides."""

    def composed(self, overrides: Sequence[str]) -> Composed:
        """Return the configuration that overrides make; what differs in the seed alone is composed once."""
        seeds = [override for override in overrides if override.startswith("seed=")]
        others = tuple(override for override in overrides if override not in seeds)
        if others not in self._made:
            self._made[others] = _composed(self.compose(others))
        if not seeds:
            return self._made[others]
        seed = parse(seeds[-1]).value()
        if type(seed) is not int or self._made[others].uses_seed:
            return _composed(self.compose(overrides))
        return self._made[others].with_seed(seed)

    # Functions, so that they can be sent to a sweep's processes.
    do: Callable[[Any], Any]  # does one job
    do_group: Callable[[Sequence[Any]], list[Exception | None]]  # does jobs and returns what each failed with
    groups: Callable[[Sequence[Any]], list[list[int]]]  # positions of the configurations that one process does
    row: Callable[[dict[str, Any]], dict[str, str]]  # what a sweep's table shows of a job's summary

    def check(self, config: Any) -> None:
        """Raise where something that the jobs need is not installed."""

    def spelt_out(self, overrides: Sequence[str]) -> list[str]:
        """Return a job's overrides with those replaced that are short for others."""
        return list(overrides)

    def jobs(self, overrides_of_jobs: Sequence[Sequence[str]]) -> list[Job]:
        """Return the jobs with these overrides, in their order."""
        self._made = {}
        jobs = [self.job(own) for own in counted(overrides_of_jobs, "jobs composed")]
        _check_shared_folders(jobs)
        return jobs

    def expand(self, overrides: Sequence[str], multirun: bool) -> list[list[str]]:
        """Return the overrides of every job that a command's overrides ask for, in the order of Hydra's own sweeper."""
        if not self.is_sweep(overrides, multirun):
            return [self.spelt_out(overrides)]
        parameters = self._experiment(tuple(overrides))[1]
        return [self.spelt_out(own) for own in combinations((*parameters, *overrides))]

    def is_sweep(self, overrides: Sequence[str], multirun: bool) -> bool:
        """Return whether a command's overrides ask for a sweep: by -m, or by an experiment that says so."""
        swept = [parsed.get_key_element() for parsed in map(self.parsed, overrides) if parsed.is_sweep_override()]
        if swept and not multirun and not any(override.startswith("+experiment=") for override in overrides):
            lists = [f"{key}=[...]" for key in swept if self.takes_list(key)]
            one = f", or write one list as {', '.join(lists)}" if lists else ""
            raise ConfigError(f"{', '.join(swept)}: several values make a sweep; add -m{one}")
        if any(key.lstrip("+") == "experiment" for key in swept):
            raise ConfigError("experiment: one at a time; start a command for each")
        if multirun or self._experiment(tuple(overrides))[0]:
            return True
        for override in overrides:
            if key_of(override) == "launcher" and override != "launcher=basic":
                raise ConfigError(f"{override} launches a sweep's jobs, and this is one job; add -m, or leave it out")
        return False

    @functools.cache  # noqa: B019 - there are two workflows, which live as long as the process
    def _experiment(self, overrides: tuple[str, ...]) -> tuple[bool, list[str]]:
        """Return whether the experiment that overrides name is a sweep, and the parameters that it brings.

        What conf/experiment/<name>/<budget>.yaml has comes on top of the experiment's own, so that a budget may sweep
        less.
        """
        single = [override for override in overrides if not parse(override).is_sweep_override()]
        experiments = [override for override in single if key_of(override) == "experiment"]
        if not experiments:
            return False, []
        budgets = [override for override in single if override.startswith("budget=") and "budget" in self.checked]
        for override in (*experiments, *budgets):
            group, _, option = override.lstrip("+").partition("=")
            self.check_option(group, option)
        own = [f"{self.needs[0]}={self.anything}", *budgets, *experiments]
        settings = self.settings_of_hydra(own)
        name = experiments[-1].split("=", 1)[1]
        own_budget = (settings.sweeper.params or {}).get("budget")
        budget = settings.runtime.choices.get("budget") if budgets or own_budget is None else own_budget
        if (CONF_DIR / self.folder / "experiment" / name / f"{budget}.yaml").is_file():
            settings = self.settings_of_hydra([*own, f"+experiment/{name}={budget}"])
        parameters = [f"{key}={value}" for key, value in (settings.sweeper.params or {}).items()]
        return str(settings.mode).endswith("MULTIRUN"), parameters

    def differences(self, config: Any, overrides: Sequence[str], named: Container[str] = ()) -> dict[str, list[Any]]:
        """Return what overrides change that the folder of a job does not name, as {setting: [value, usual one]}.

        The usual settings are those of the same options without the values, which Hydra need not compose again. Options
        stand for themselves, and so do values where their options do not go together without them. `named` are options
        that the folder names besides.
        """
        changing = [override for override in overrides if override not in named and not self.is_plain(override)]
        values = [override for override in changing if self.is_value(override)]
        found = dict[str, list[Any]]()
        if values:
            try:
                usual = self.composed([override for override in overrides if override not in values]).config
                found = setting_differences(config.settings(), usual.settings())
            except ConfigError:
                values = []
        options = (override for override in changing if override not in values)
        return found | {key_of(override): [override.partition("=")[2], None] for override in options}

    @functools.cache  # noqa: B019 - as above
    def is_plain(self, override: str) -> bool:
        """Return whether an override changes nothing of what comes out but what the folder of a job names."""
        key, _, value = override.lstrip("+").partition("=")
        if key == "experiment":  # one that brings values to sweep over, and no settings that decide what comes out
            path = CONF_DIR / self.folder / "experiment" / f"{value}.yaml"
            return path.is_file() and OmegaConf.load(path).keys() <= {"hydra", *self.harmless}
        return key in (*self.naming, *self.harmless) or is_of_launching(override)


def _check_shared_folders(jobs: Sequence[Job]) -> None:
    """Raise ConfigError where two jobs would make a stage of one folder from different inputs, in turns."""
    first: dict[Path, Job] = {}
    for job in jobs:
        other = first.setdefault(job.run_dir, job)
        theirs, ours = ({stage.name: stage.inputs for stage in each.stages} for each in (other, job))
        for name in sorted(theirs.keys() & ours.keys()):
            if theirs[name] != ours[name]:
                raise ConfigError(
                    f"{job.run_dir}: two jobs of this sweep make the {name} there, one from {', '.join(theirs[name])} "
                    f"and one from {', '.join(ours[name])}; start a command for each, with a results_dir each if both "
                    "are wanted"
                )


def _composed(cfg: DictConfig) -> Composed:
    uses_seed = re.search(r"\$[^}\n]*seed", OmegaConf.to_yaml(cfg)) is not None
    return Composed(to_object(cfg), OmegaConf.to_yaml(cfg, resolve=True), uses_seed)
