import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from pipelines.supervised.config import LEARNERS, DataConfig, FitConfig


@pytest.fixture
def fit_of(tmp_path: Path) -> Callable[..., FitConfig]:
    """Return a function that makes a fit below tmp_path: `fit_of("cart", max_depth=2)`; `seed=` is the fit's own."""

    def make(learner: str, data: str = "breast_cancer", seed: int = 0, **settings: object) -> FitConfig:
        method = dataclasses.replace(LEARNERS[learner](learner, learner), **settings)
        folder = f"runs/{data}/{learner}/seed-{seed}"
        return FitConfig(DataConfig(data), method, seed, str(tmp_path / "results"), folder=folder)

    return make
