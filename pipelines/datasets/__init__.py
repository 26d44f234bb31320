"""The data sets of Table 4.2 with the splits of Lee & Jaakkola (ICLR 2020), and scikit-learn's as offline examples."""

from pipelines.datasets.catalogue import NAMES
from pipelines.datasets.dataset import Dataset, Part
from pipelines.datasets.fragments import fragment_names
from pipelines.datasets.load import load_dataset

__all__ = ["NAMES", "Dataset", "Part", "fragment_names", "load_dataset"]
