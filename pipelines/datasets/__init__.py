"""The data sets of Table 4.2 with the splits of Lee & Jaakkola (ICLR 2020), scikit-learn's, and tables of the user."""

from pipelines.datasets.catalogue import NAMES
from pipelines.datasets.columns import Columns
from pipelines.datasets.dataset import Dataset, Part
from pipelines.datasets.fragments import fragment_names
from pipelines.datasets.load import load_dataset
from pipelines.datasets.table import load_table

__all__ = ["NAMES", "Columns", "Dataset", "Part", "fragment_names", "load_dataset", "load_table"]
