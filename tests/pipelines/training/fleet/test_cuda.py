"""The fleet on a GPU: the processor's numbers, the captured graph's, and whole runs. Skipped where there is none."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.config import FleetConfig
from pipelines.engine.store import read_csv
from pipelines.training.fleet.replay_buffer import FleetReplay, RowLayout, open_rows
from pipelines.training.fleet.sac import FleetSac, Minibatch, RunSettings, Shapes
from pipelines.training.fleet.train import train_fleet
from pipelines.training.fleet.updates import Updates
from tests.pipelines.conftest import SAC
from tests.pipelines.training.fleet.test_sac import BATCH, N_ACTIONS, N_INPUTS, draw_batch, stacked

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
SHAPES = Shapes(N_INPUTS, N_ACTIONS, (6,), (256, 256), BATCH)
SEEDS = [0, 1, 2]


def fleet_on(device: str) -> FleetSac:
    """Return a fleet of three runs with the same first weights on whatever device."""
    fleet = FleetSac(SHAPES, [RunSettings(1e-3, 0.99)] * len(SEEDS), torch.device(device))
    for run, seed in enumerate(SEEDS):
        fleet.initialise(run, torch.Generator().manual_seed(seed))
    return fleet


def test_fifty_updates_are_the_processors():
    fleets = [fleet_on("cpu"), fleet_on("cuda")]
    start = {name: tensor.clone() for name, tensor in fleets[0].tensors(1).items()}
    generators = [torch.Generator().manual_seed(1000 + seed) for seed in SEEDS]
    for _ in range(50):
        batch, noise = stacked([draw_batch(generator) for generator in generators])
        fleets[0].update(batch, noise)
        moved = Minibatch(*(getattr(batch, field.name).cuda() for field in dataclasses.fields(batch)))
        fleets[1].update(moved, noise.cuda())
    for name, tensor in fleets[0].tensors(1).items():
        other = fleets[1].tensors(1)[name].cpu()
        assert float((tensor - other).norm()) < 1e-2 * float((tensor - start[name]).norm()), name


def test_the_graph_does_what_single_updates_do(tmp_path: Path):
    layout, capacity = RowLayout(N_INPUTS, N_ACTIONS), 1000
    files = [open_rows(tmp_path / str(seed), capacity, layout) for seed in SEEDS]
    for file in files:
        file[:] = np.random.default_rng(0).standard_normal(file.shape, dtype=np.float32)
    device = torch.device("cuda")
    generator = torch.Generator(device).manual_seed(0)
    draws = [
        (
            torch.randint(capacity, (3, 4, BATCH), generator=generator, device=device),
            torch.randn(3, 4, 2 * BATCH, N_ACTIONS, generator=generator, device=device),
        )
        for _ in range(8)
    ]
    graphed, plain = fleet_on("cuda"), fleet_on("cuda")
    replay = FleetReplay(files, layout, capacity, device)
    updates = Updates(graphed, replay)
    for positions, noise in draws:
        updates(positions, noise)
        for e in range(4):
            plain.update(replay.gather(positions[:, e]), noise[:, e])
    assert graphed.n_updates == plain.n_updates == 32
    for name, tensor in plain.tensors(2).items():
        torch.testing.assert_close(tensor, graphed.tensors(2)[name], rtol=1e-4, atol=1e-6, msg=name)


def test_whole_runs(tiny, tmp_path):
    fleet = FleetConfig("fleet_gpu", 4, "fp32", "gymnasium", "cuda", 40)
    configs = [tiny(seed=seed, trainer=fleet, algo=dataclasses.replace(SAC, buffer_size=150)) for seed in SEEDS]
    outs = [tmp_path / str(seed) for seed in SEEDS]
    for out in outs:
        out.mkdir()
    assert train_fleet(configs, outs) == [None] * 3
    assert [row["steps"] for row in read_csv(outs[0] / "evaluations.csv")] == ["100", "200", "300"]
