"""The command line: the only place that knows Hydra and OmegaConf."""

from pipelines.cli.commands import export, fit, plan, run, tabulate, verify

__all__ = ["export", "fit", "plan", "run", "tabulate", "verify"]
