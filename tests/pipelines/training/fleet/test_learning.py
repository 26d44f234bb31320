"""What a fleet learns is what Stable-Baselines3 learns: learning curves of five seeds each on Pendulum."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from pipelines.config.stages import TrainConfig
from pipelines.config.trainer import FleetConfig
from pipelines.engine.store import read_csv
from pipelines.stages.train import checkpoint_folder
from pipelines.stages.train import train as train_by_sb3
from pipelines.training.fleet.train_fleet import train_fleet
from tests.pipelines.conftest import SAC

THESIS_SAC = dataclasses.replace(SAC, batch_size=100, critic=[256, 256], learning_starts=1_000)
FLEET = FleetConfig("fleet", 1, 5)
SEEDS = range(5)
STEPS, INTERVAL = 6_000, 1_000
RANDOM_RETURN, LEARNT_RETURN = -1_000, -350


def curve(out):
    return [float(row["return_mean"]) for row in read_csv(out / "evaluations.csv")]


@pytest.mark.slow
def test_learning_curves_are_not_distinguishable(tiny, tmp_path):
    configs = [
        tiny(seed=seed, depth=6, algo=THESIS_SAC, train=TrainConfig(STEPS, INTERVAL, 10, 1_000)) for seed in SEEDS
    ]
    outs = {side: [tmp_path / f"{side}-{seed}" for seed in SEEDS] for side in ("sb3", "fleet")}
    for out in (*outs["sb3"], *outs["fleet"]):
        out.mkdir()
    for config, out in zip(configs, outs["sb3"], strict=True):
        train_by_sb3({}, config, out)
    fleet = [dataclasses.replace(config, trainer=FLEET) for config in configs]
    assert train_fleet(fleet, [checkpoint_folder(config) for config in fleet], outs["fleet"]) == [None] * len(fleet)

    curves = {side: np.array([curve(out) for out in outs[side]]) for side in outs}
    print({side: values.mean(0).round(1).tolist() for side, values in curves.items()})
    for side, values in curves.items():
        assert values[:, 0].mean() < RANDOM_RETURN, f"{side} begins at {values[:, 0]}"
        assert values[:, -2:].mean() > LEARNT_RETURN, f"{side} ends at {values[:, -2:]}"
    # Each run's whole curve after learning starts, and its end; five against five, exact test.
    for what in (slice(1, None), slice(-2, None)):
        means = [curves[side][:, what].mean(1) for side in ("sb3", "fleet")]
        p = mannwhitneyu(*means).pvalue
        assert p > 0.05, f"evaluations {what}: Stable-Baselines3 {means[0]}, fleet {means[1]}, p = {p}"
