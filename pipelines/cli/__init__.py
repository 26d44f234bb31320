"""The command line: the only place that knows Hydra and OmegaConf. Each command has its entry point here."""

from functools import partial

from pipelines.cli.main import main, stopping_without_extra

run = partial(main, "otr-run")
plan = partial(main, "otr-plan")
fit = partial(main, "otr-fit")
tabulate = partial(main, "otr-tabulate")
export = partial(main, "otr-export")
verify = partial(main, "otr-verify")
report = partial(main, "otr-report")


def data() -> None:
    """Entry point of `otr-data`."""
    with stopping_without_extra("otr-data"):
        from pipelines.datasets import command  # reads data sets without Hydra

        command.run()
