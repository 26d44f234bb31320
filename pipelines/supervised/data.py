"""The data set of a fit, read once a process."""

import functools

from pipelines.datasets.dataset import Dataset
from pipelines.datasets.load import load_dataset
from pipelines.supervised.config import FitConfig


def dataset_of(config: FitConfig) -> Dataset:
    """Return the fit's data set; errors as `load_dataset`'s."""
    return _loaded(config.data.name)


@functools.lru_cache(maxsize=1)
def _loaded(name: str) -> Dataset:
    return load_dataset(name)
