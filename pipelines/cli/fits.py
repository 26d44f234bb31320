"""The overrides of `otr-fit`: from them to jobs."""

import dataclasses
from collections.abc import Sequence

from pipelines.cli.overrides import key_of
from pipelines.cli.workflow import Workflow
from pipelines.config.setting import not_keyed
from pipelines.errors import ConfigError
from pipelines.supervised.config import LEARNERS, TUNING_ALONE, DataConfig, FitConfig, LearnerConfig, fit_folder
from pipelines.supervised.fit_job import FitJob, fit_groups, fit_job, fit_jobs
from pipelines.supervised.result import fit_row


class FitWorkflow(Workflow):
    """`otr-fit`, whose jobs are fits."""

    folder = "fit"
    needs = ("data", "data set")
    anything = "bace"
    decisive = ("data.split",)
    naming = ("data", "data.split", "method", "seed")
    harmless = not_keyed(FitConfig)
    do = staticmethod(fit_job)
    do_group = staticmethod(fit_jobs)
    groups = staticmethod(fit_groups)
    row = staticmethod(fit_row)

    def implied(self, overrides: Sequence[str]) -> list[str]:
        """Return what parts that are drawn anew imply: no settings that were tuned on the published ones."""
        is_drawn = any(key_of(each) == "data.split" and not each.endswith("=null") for each in overrides)
        return ["published=none"] if is_drawn else []

    def job(self, overrides: Sequence[str]) -> FitJob:
        """Return the fit with these overrides."""
        made = self.composed(overrides)
        config: FitConfig = made.config
        _check_tuning(config.method, overrides)
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
                f"{override}: method={method.name} tunes {name}, and what is given would be passed over; add "
                f"method.grid=[], and nothing is tuned, or leave {override} out"
            )
        if group == "method" and not method.grid and name in TUNING_ALONE:
            raise ConfigError(f"{override}: nothing is tuned; leave {override} out, or give method.grid")


FIT = FitWorkflow(
    "fit",
    {
        (None, "fit_schema"): FitConfig,
        (None, "data_schema"): DataConfig,
        **{("method", f"{name}_schema"): learner for name, learner in LEARNERS.items()},
    },
    checked=("data", "method", "launcher", "experiment"),
)
