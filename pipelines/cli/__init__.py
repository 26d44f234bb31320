"""The command line: the only place that knows Hydra and OmegaConf."""

from pipelines.cli.main import main, stopping_without_extra


def run() -> None:
    """Entry point of `otr-run`."""
    main("otr-run")


def plan() -> None:
    """Entry point of `otr-plan`."""
    main("otr-plan")


def fit() -> None:
    """Entry point of `otr-fit`."""
    main("otr-fit")


def tabulate() -> None:
    """Entry point of `otr-tabulate`."""
    main("otr-tabulate")


def export() -> None:
    """Entry point of `otr-export`."""
    main("otr-export")


def verify() -> None:
    """Entry point of `otr-verify`."""
    main("otr-verify")


def data() -> None:
    """Entry point of `otr-data`."""
    with stopping_without_extra("otr-data"):
        from pipelines.datasets import command  # reads data sets without Hydra

        command.run()
