"""The words of `otr-fit`: from them to jobs."""

import dataclasses
import functools
from collections.abc import Sequence

from omegaconf import DictConfig, OmegaConf

from pipelines.cli.compose import Composer, to_object
from pipelines.cli.workflow import Workflow, command_of
from pipelines.engine.job import Job
from pipelines.supervised.config import LEARNERS, DataConfig, FitConfig, fit_folder
from pipelines.supervised.fit_job import FitJob, fit_groups, fit_job, fit_jobs


def _fit_job(cfg: DictConfig, overrides: Sequence[str]) -> Job:
    config = to_object(cfg)
    assert isinstance(config, FitConfig)
    baseline = _fit_config((f"data={config.data.name}", f"method={config.method.name}"))
    folder = fit_folder(config, dataclasses.replace(baseline, seed=config.seed))
    return FitJob(
        config=dataclasses.replace(config, folder=folder),
        folder=folder,
        config_yaml=OmegaConf.to_yaml(cfg, resolve=True),
        command=command_of("otr-fit", overrides),
    )


@functools.cache
def _fit_config(words: tuple[str, ...]) -> FitConfig:
    config = to_object(FIT.composer.compose(words))
    assert isinstance(config, FitConfig)
    return config


FIT = Workflow(
    "otr-fit",
    Composer(
        "fit",
        folder="fit",
        groups=("data", "method", "launcher", "experiment"),
        needs="data",
        anything="bace",
        schemas={
            (None, "fit_schema"): FitConfig,
            (None, "data_schema"): DataConfig,
            **{("method", f"{name}_schema"): learner for name, learner in LEARNERS.items()},
        },
    ),
    job=_fit_job,
    groups=fit_groups,
    do=fit_job,
    do_group=fit_jobs,
    check=lambda config: None,
)
