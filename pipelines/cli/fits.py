"""The overrides of `otr-fit`: from them to jobs."""

import dataclasses
from collections.abc import Sequence

from pipelines.cli.overrides import key_of
from pipelines.cli.workflow import Workflow
from pipelines.config.setting import not_keyed
from pipelines.supervised.config import LEARNERS, DataConfig, FitConfig, fit_folder
from pipelines.supervised.fit_job import FitJob, fit_groups, fit_job, fit_jobs


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

    def implied(self, overrides: Sequence[str]) -> list[str]:
        """Return what parts that are drawn anew imply: no settings that were tuned on the published ones."""
        is_drawn = any(key_of(each) == "data.split" and not each.endswith("=null") for each in overrides)
        return ["published=none"] if is_drawn else []

    def job(self, overrides: Sequence[str]) -> FitJob:
        """Return the fit with these overrides."""
        made = self.composed(overrides)
        config: FitConfig = made.config
        baseline = config
        if not all(map(self.is_plain, overrides)):
            split = [] if config.data.split is None else [f"data.split={config.data.split}"]
            named = self.composed([f"data={config.data.name}", f"method={config.method.name}", *split])
            baseline = dataclasses.replace(named.config, seed=config.seed)
        folder = fit_folder(config, baseline)
        return FitJob(dataclasses.replace(config, folder=folder), folder, made.yaml, tuple(overrides))


FIT = FitWorkflow(
    "fit",
    {
        (None, "fit_schema"): FitConfig,
        (None, "data_schema"): DataConfig,
        **{("method", f"{name}_schema"): learner for name, learner in LEARNERS.items()},
    },
    checked=("data", "method", "launcher", "experiment"),
)
