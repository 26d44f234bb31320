"""The command line: the only place that knows Hydra and OmegaConf. Each command has its entry point here."""

import sys
from functools import partial

from pipelines.cli.main import ending, main

run = partial(main, "otr-run")
plan = partial(main, "otr-plan")
fit = partial(main, "otr-fit")
tabulate = partial(main, "otr-tabulate")
export = partial(main, "otr-export")
verify = partial(main, "otr-verify")
report = partial(main, "otr-report")


def data() -> None:
    """Entry point of `otr-data`."""
    with ending("otr-data"):
        from pipelines.datasets.command import main as do  # reads data sets without Hydra

        sys.exit(do(sys.argv[1:]))
