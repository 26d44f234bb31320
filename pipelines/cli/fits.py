"""The overrides of `otr-fit`: from them to jobs."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from pipelines.cli.overrides import key_of, parse, quoted
from pipelines.cli.workflow import Workflow
from pipelines.config.setting import not_keyed
from pipelines.datasets.catalogue import NAMES
from pipelines.datasets.table import is_table
from pipelines.errors import ConfigError
from pipelines.supervised.config import LEARNERS, TABLE, TUNING_ALONE, DataConfig, FitConfig, LearnerConfig, fit_folder
from pipelines.supervised.fit_job import FitJob, fit_groups, fit_job, fit_jobs
from pipelines.supervised.learners import dataset_of
from pipelines.supervised.result import fit_row

OF_TABLES = ("target", "task", "drop")  # settings of a table's data


class FitWorkflow(Workflow):
    """`otr-fit`, whose jobs are fits."""

    folder = "fit"
    needs = ("data", "data set")
    anything = "bace"
    besides = ", or a table as data=FILE.csv target=COLUMN"
    short = OF_TABLES
    decisive = ("data.split",)
    naming = ("data", "data.split", "method", "seed")
    harmless = not_keyed(FitConfig)
    do = staticmethod(fit_job)
    do_group = staticmethod(fit_jobs)
    groups = staticmethod(fit_groups)
    row = staticmethod(fit_row)

    def spelt_out(self, overrides: Sequence[str]) -> list[str]:
        """Return overrides with those of a table spelt out: data=my.csv is data=table and data.file=my.csv."""
        written = []
        for override in overrides:
            key = key_of(override)
            path = str(parse(override).value()) if key == "data" else ""
            if is_table(path):
                written += ["data=table", f"data.file={quoted(path)}", f"data.name={quoted(Path(path).name)}"]
            else:
                written.append(f"data.{override}" if key in OF_TABLES else override)
        return written

    def implied(self, overrides: Sequence[str]) -> list[str]:
        """Return what redrawn parts imply: no settings that were tuned on the published ones."""
        is_drawn = any(key_of(each) == "data.split" and not each.endswith("=null") for each in overrides)
        return ["published=none"] if is_drawn else []

    def job(self, overrides: Sequence[str]) -> FitJob:
        """Return the fit with these overrides."""
        made = self.composed(overrides)
        config: FitConfig = made.config
        _check_tuning(config.method, overrides)
        if config.data.file is not None or config.data.name == TABLE:
            dataset_of(config)  # its errors are raised before anything is written
        folder = fit_folder(config, self.differences(config, overrides))
        return FitJob(dataclasses.replace(config, folder=folder), folder, made.yaml, tuple(overrides))


def _check_tuning(method: LearnerConfig, overrides: Sequence[str]) -> None:
    """Raise ConfigError where an override sets what is tuned, or how to tune where nothing is."""
    tuned = {key for values in method.grid for key in values}
    for override in overrides:
        group, _, key = key_of(override).partition(".")
        name = key.partition(".")[0]
        if group == "method" and name in tuned:
            raise ConfigError(
                f"{override}: method={method.name} tunes {name}, and what is given would be ignored; add "
                f"method.grid=[], and nothing is tuned, or leave {override} out"
            )
        if group == "method" and not method.grid and name in TUNING_ALONE:
            raise ConfigError(f"{override}: nothing is tuned; leave {override} out, or give method.grid")


FIT = FitWorkflow(
    "fit",
    {
        (None, "fit_schema"): FitConfig,
        **{("data", name): DataConfig for name in (*NAMES, TABLE)},
        **{("method", f"{name}_schema"): learner for name, learner in LEARNERS.items()},
    },
    checked=("data", "method", "launcher", "experiment"),
)
