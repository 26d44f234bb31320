"""Sweeps under Hydra's launchers: groups of jobs, each done in whatever process a launcher starts."""

import itertools
import os
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig

from pipelines.cli.fits import FIT
from pipelines.cli.messages import message_of
from pipelines.cli.runs import RUN
from pipelines.cli.workflow import Workflow
from pipelines.engine.job import Job, record_failure
from pipelines.engine.sweep import Outcome, is_sweep_word, quoted, run_sweep, side_by_side
from pipelines.errors import ConfigError

# What a job's settings depend on outside of its words; a cluster's processes have not inherited it. No secrets here:
# launchers write tasks to disk.
CARRIED_VARIABLES = (
    "OTR_RESULTS_DIR", "OTR_DATA_DIR", "XDG_DATA_HOME", "MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME",
)  # fmt: skip


def do_sweep(workflow: Workflow, overrides: list[str]) -> bool:
    """Do every job of a sweep and return whether all are done; failing ones do not stop the others and are named."""
    words = workflow.composer.expand(overrides, multirun=True)
    if not words:
        raise ConfigError("these words make no job; look for an empty range()")
    jobs = workflow.jobs(words)
    workflow.check(jobs[0].config)
    name = sweep_name()
    own = [[word for word in job if not is_sweep_word(word) or word.startswith("launcher=")] for job in words]

    def launch(left: Sequence[int]) -> list[Outcome]:
        return _launch(workflow, name, overrides, [jobs[i] for i in left], [own[i] for i in left])

    outcomes = run_sweep(jobs, launch)
    failed = [outcome for outcome in outcomes if outcome.error]
    print(f"\n{len(outcomes)} jobs: {len(outcomes) - len(failed)} done, {len(failed)} failed")
    for outcome in failed:
        print(f"  {outcome.folder}: {outcome.error}")
        if outcome.traceback:
            print(f"    traceback: {outcome.traceback}")
    return not failed


def _launch(
    workflow: Workflow, name: str, overrides: list[str], jobs: Sequence[Job], words: Sequence[list[str]]
) -> list[Outcome]:
    """Do jobs, each with its own words, under the launcher that the overrides ask for, group by group."""
    groups = workflow.groups([job.config for job in jobs])
    carried = {variable: os.environ.get(variable) for variable in CARRIED_VARIABLES}
    grouped = [[words[i] for i in group] for group in groups]
    task = _SweepTask(workflow.program, name, str(Path.cwd()), carried, grouped)
    # Absolute, because Hydra makes this folder in whatever folder a launcher starts the job.
    sweep_dir = quoted(str(Path(jobs[0].config.results_dir).absolute() / "sweeps"))
    # The launcher's settings are any job's: the first one's, for there are no defaults for what is swept.
    of_hydra = [word for word in overrides if word.lstrip("+").startswith(("hydra.", "hydra/"))]
    asked = workflow.composer.sweep_words([*words[0], *of_hydra, "hydra.mode=MULTIRUN", f"hydra.sweep.dir={sweep_dir}"])
    with workflow.composer.hydra():
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        cfg = hydra.compose_config(workflow.composer.name, asked, run_mode=RunMode.MULTIRUN)
        context = HydraContext(config_loader=hydra.config_loader, callbacks=Callbacks(cfg))
        if "submitit_folder" in cfg.hydra.launcher:
            print(
                f"{len(jobs)} jobs handed over; what they print: {jobs[0].config.results_dir}/sweeps/.submitit",
                flush=True,
            )
        launcher = Plugins.instance().instantiate_launcher(context, task, cfg)
        first_words = [words[group[0]] for group in groups]
        returned = [result.return_value for result in launcher.launch(first_words, initial_job_idx=0)]
    outcomes = dict(zip(itertools.chain(*groups), itertools.chain(*returned), strict=True))
    return [outcomes[i] for i in range(len(jobs))]


@dataclass(frozen=True)
class _SweepTask:
    """Does one group of a sweep's jobs in whatever process a launcher starts; reports failures instead of raising them.

    Attributes:
        program: names the workflow.
        sweep: names the folder of the sweep's failures.
        cwd: where the command was given, which relative paths start from.
        environment: the variables there that settings depend on; None where one is not set.
        groups: the words of every job, group by group; a launcher is given the first of each.
    """

    program: str
    sweep: str
    cwd: str
    environment: dict[str, str | None]
    groups: list[list[list[str]]]

    def __call__(self, cfg: DictConfig) -> list[Outcome]:
        os.chdir(self.cwd)
        for name, value in self.environment.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
        first = list(HydraConfig.get().overrides.task)
        workflow = {"otr-run": RUN, "otr-fit": FIT}[self.program]
        jobs = workflow.jobs(next(group for group in self.groups if group[0] == first))
        if HydraConfig.get().runtime.choices["hydra/launcher"] != "basic":
            jobs = [side_by_side(job) for job in jobs]
        outcomes: list[Outcome] = []
        before = None
        for job, error in zip(jobs, workflow.do_group(jobs), strict=True):
            outcomes.append(self._outcome(job, error, error is not None and error is before))
            before = error
        return outcomes

    def _outcome(self, job: Job, error: Exception | None, is_told: bool) -> Outcome:
        """Return how a job ended; what a group failed with as a whole is told with the first of its jobs alone."""
        if error is None:
            return Outcome(job.folder)
        path = record_failure(job, error, self.sweep)
        message = message_of(error)
        if job.config.debug:
            traceback.print_exception(error)
        print(f"{job.folder} failed: {'so, too' if is_told else message}", file=sys.stderr, flush=True)
        return Outcome(job.folder, message.splitlines()[0], path)


def sweep_name() -> str:
    """Return the name of the folder that holds the failures of what is done now."""
    return time.strftime("%Y-%m-%d_%H-%M-%S")
