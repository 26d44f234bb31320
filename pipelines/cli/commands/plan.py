"""`otr-plan`: list what `otr-run` would do."""

import argparse

from pipelines.cli.jobs_file import how_to_use, write_jobs
from pipelines.cli.overrides import asked
from pipelines.cli.runs import RUN
from pipelines.runs.plan import print_plan
from pipelines.runs.run_job import RunJob


def do(arguments: argparse.Namespace) -> int:
    """Print the plan and write the file of jobs that --jobs names."""
    overrides = asked(arguments)
    jobs = [job for job in RUN.jobs(RUN.expand(overrides, arguments.multirun)) if isinstance(job, RunJob)]
    print_plan(jobs)
    if arguments.jobs:
        n_jobs = write_jobs(arguments.jobs, jobs, RUN.groups)
        print(f"\n{how_to_use(arguments.jobs, n_jobs)}")
    return 0
