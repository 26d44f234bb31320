"""`otr-plan`: list what `otr-run` would do."""

import argparse

from pipelines.cli.overrides import asked
from pipelines.cli.runs import RUN
from pipelines.runs.plan import print_plan
from pipelines.runs.run_job import RunJob


def do(arguments: argparse.Namespace) -> int:
    """Print the plan."""
    jobs = RUN.jobs(RUN.expand(asked(arguments), arguments.multirun))
    print_plan([job for job in jobs if isinstance(job, RunJob)])
    return 0
