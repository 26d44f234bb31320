"""The overrides of `otr-fit`: from them to jobs."""

import dataclasses
from collections.abc import Sequence

from pipelines.cli.workflow import Workflow
from pipelines.config.setting import not_keyed
from pipelines.supervised.config import LEARNERS, DataConfig, FitConfig, fit_folder
from pipelines.supervised.fit_job import FitJob, fit_groups, fit_job, fit_jobs


class FitWorkflow(Workflow):
    """`otr-fit`, whose jobs are fits."""

    folder = "fit"
    needs = ("data", "data set")
    anything = "bace"
    naming = ("data", "data.split", "method", "seed")
    harmless = not_keyed(FitConfig)
    do = staticmethod(fit_job)
    do_group = staticmethod(fit_jobs)
    groups = staticmethod(fit_groups)

    def job(self, overrides: Sequence[str]) -> FitJob:
        """Return the fit with these overrides."""
        made = self.composed(overrides)
        config: FitConfig = made.config
        baseline = config
        if not all(map(self.is_plain, overrides)):
            named = self.composed([f"data={config.data.name}", f"method={config.method.name}"])
            data = dataclasses.replace(named.config.data, split=config.data.split)
            baseline = dataclasses.replace(named.config, data=data, seed=config.seed)
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
