"""The returns of random actions, and what to look for where an imported policy returns less."""

import csv
from collections.abc import Mapping
from importlib import resources
from typing import Any

from pipelines.config.run import RunConfig


def random_returns(key: str = "task") -> dict[str, float]:
    """Return the mean return of random actions by task, or by another column of the file, such as `env_id`.

    `python -m pipelines.cli.random_returns` measured them.
    """
    text = (resources.files("pipelines") / "random_returns.csv").read_text(encoding="utf-8")
    return {row[key]: float(row["mean"]) for row in csv.DictReader(text.splitlines())}


def warning_below_random(config: RunConfig, summary: Mapping[str, Any]) -> str | None:
    """Return what may be wrong with a policy from a file; None where it returns more, or nothing is known of that."""
    random = None if config.env.kwargs else random_returns("env_id").get(config.env.id)
    if config.imported is None or random is None:
        return None
    policy = "oracle" if config.method.imitates else "network"
    mean = float(summary["policies"][policy]["return_mean"])
    if mean >= random:
        return None
    is_raw_zip = config.imported.name.endswith(".zip") and not config.imported.is_normalised
    remedy = "was it trained under VecNormalize? normalise=FILE names the file of its statistics"
    others = "was it trained for another environment, or with wrappers that this one lacks?"
    return (
        f"{config.imported.name} returns {mean:,.1f}, less than random actions do in {config.env.id} ({random:,.1f}): "
        f"{remedy if is_raw_zip else others}"
    )
