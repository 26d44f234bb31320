"""Small problems with the look of the molecules': binary inputs with few ones, several labels, some missing."""

import numpy as np
import pytest
import torch


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def fingerprints():
    """300 rows of 120 inputs, a tenth of them ones, and 3 labels, a sixth of them missing."""
    rng = np.random.default_rng(0)
    X = (rng.random((300, 120)) < 0.1).astype(np.float64)
    Y = (X @ rng.normal(size=(120, 3)) > 0).astype(np.float64)
    Y[rng.random(Y.shape) < 1 / 6] = np.nan
    return X, Y
