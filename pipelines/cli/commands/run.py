"""`otr-run`: do runs."""

import argparse
import sys

from omegaconf import OmegaConf

from pipelines.cli.overrides import asked
from pipelines.cli.runs import RUN
from pipelines.cli.sweeps import do_sweep, sweep_name
from pipelines.cli.workflow import Workflow
from pipelines.engine.job import record_failure
from pipelines.errors import PipelineError


def do(arguments: argparse.Namespace) -> int:
    """Do the runs that the overrides ask for."""
    return do_jobs(RUN, arguments)


def do_jobs(workflow: Workflow, arguments: argparse.Namespace) -> int:
    """Do the jobs that the overrides ask for, one or a sweep, or print the configuration of the first of them."""
    overrides = asked(arguments)
    is_sweep = workflow.is_sweep(overrides, arguments.multirun)
    if arguments.cfg:
        first = workflow.expand(overrides, arguments.multirun)[0]
        print(OmegaConf.to_yaml(workflow.compose(first), resolve=True))
        return 0
    if is_sweep:
        return 0 if do_sweep(workflow, overrides) else 1
    (job,) = workflow.jobs(workflow.expand(overrides, multirun=False))
    workflow.check(job.config)
    try:
        workflow.do(job)
    except (PipelineError, BrokenPipeError):
        raise
    except Exception as error:
        print(f"traceback: {record_failure(job, error, sweep_name())}", file=sys.stderr)
        raise
    return 0
