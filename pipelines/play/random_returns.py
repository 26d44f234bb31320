"""The returns of random actions, as `python -m pipelines.cli.random_returns` measured them."""

import csv
from importlib import resources


def random_returns(key: str = "task") -> dict[str, float]:
    """Return the mean return of random actions by task, or by another column of the file, such as `env_id`."""
    text = (resources.files("pipelines") / "random_returns.csv").read_text(encoding="utf-8")
    return {row[key]: float(row["mean"]) for row in csv.DictReader(text.splitlines())}
