"""RAND's Health Insurance Experiment: how often a person saw a doctor in a year, by their insurance and their health.

A row is a person's year, and those of a person are adjacent. The rows are split by blocks, so that a person is in one
part, but for those at a block's end.
"""

import csv
from io import StringIO

import numpy as np

from pipelines.datasets.catalogue import RANDHIE
from pipelines.datasets.dataset import Dataset, Part
from pipelines.datasets.download import read
from pipelines.datasets.splits import random_split

BLOCK = 100  # rows
VISITS = "mdvis"
# What the columns of Cameron & Trivedi, "Microeconometrics" (2005), are.
NAMES = {
    "lncoins": "log_coinsurance",  # log(1 + share of the cost that the person pays, in %)
    "idp": "individual_deductible",
    "lpi": "log_participation_incentive",
    "fmde": "log_deductible",
    "physlm": "physical_limitation",
    "disea": "n_chronic_diseases",
    "hlthg": "good_health",  # as the person rates it; excellent where all three are 0
    "hlthf": "fair_health",
    "hlthp": "poor_health",
}


def load_randhie() -> Dataset:
    """Return the counts of visits, 20,190 rows of nine features; raises as `download.read`."""
    head, *rows = csv.reader(StringIO(read(RANDHIE).decode()))
    table = np.array(rows, dtype=np.float64)
    X = table[:, [head.index(name) for name in NAMES]].astype(np.float32)
    Y = table[:, [head.index(VISITS)]]
    block = np.arange(len(table)) // BLOCK
    parts = {part: np.isin(block, blocks) for part, blocks in random_split(int(block[-1]) + 1).items()}
    named = {part: Part(X[chosen], Y[chosen], block[chosen]) for part, chosen in parts.items()}
    return Dataset("randhie", "counts", ("visits",), tuple(NAMES.values()), *named.values())
