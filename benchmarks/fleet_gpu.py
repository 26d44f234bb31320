"""The fleet on a GPU: updates a second against runs and environments, where the time goes, and Table 4.1's likely time.

    python -m benchmarks.fleet_gpu                  on a machine with a GPU; about eight minutes
    python -m benchmarks.fleet_gpu --device cpu     the same code where there is none, for trying it out

It writes results/benchmarks/fleet_gpu.json, or fleet_gpu_cpu.json. It needs torch, gymnasium with MuJoCo, numpy, scipy,
safetensors and rich, and envpool where `--environments envpool` is given; no Stable-Baselines3.

Three measurements, all on Hopper with the thesis's settings and an actor of 6 neurons:

* updates alone, as one captured graph: updates/s of all runs, for several R (runs) and E (environments a run, and
  updates a graph), with the share of the time in which the device was at work;
* a training segment: environment steps/s, and how its time splits into physics, acting and copies, and updates, each
  measured by leaving the others out;
* the time of 20 runs x 4 million steps that these give, and of all SAC runs of Table 4.1.

Predictions and outcomes are kept in benchmarks/fleet_gpu.md.
"""

import argparse
import dataclasses
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from benchmarks.__main__ import document, show
from benchmarks.measure import Entry
from pipelines.config import (
    ActorConfig,
    BudgetConfig,
    EnvConfig,
    EvaluateConfig,
    FleetConfig,
    MapConfig,
    MappedConfig,
    PruneConfig,
    RunConfig,
    SacConfig,
    TrainConfig,
)
from pipelines.engine.store import write_json
from pipelines.play.rollout import available_cores
from pipelines.training.fleet.fleet_run import FleetRun
from pipelines.training.fleet.progress import FleetProgress
from pipelines.training.fleet.replay_buffer import FleetReplay, RowLayout
from pipelines.training.fleet.sac import FleetSac, RunSettings, Shapes
from pipelines.training.fleet.train import FleetTrainer, Task
from pipelines.training.fleet.updates import EAGER_CALLS, Updates
from pipelines.training.fleet.vector_environments import make_vector_env

HOPPER = EnvConfig("hopper", "hopper", "Hopper-v4")
THESIS_SAC = SacConfig(
    "sac", 1e-3, 100, 0.99, [256, 256], 0.0, 1_000_000, 1_000, 0.005, 1, 1, "normal", 0.1, 0.01, "auto"
)
HOPPER_LAYOUT = RowLayout(11, 3)
STEPS_OF_A_RUN, RUNS_OF_A_ROW, SAC_ROWS = 4_000_000, 20, 6  # of Table 4.1: two depths of ten seeds, six SAC tasks


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        "benchmarks.fleet_gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--environments", choices=("gymnasium", "envpool"), default="envpool")
    parser.add_argument("--runs", type=int, nargs="+", default=[5, 10, 20, 40])
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 4, 8, 16])
    parser.add_argument("--seconds", type=float, default=5.0, help="of each measurement")
    asked = parser.parse_args(arguments)
    if asked.device == "cuda" and not torch.cuda.is_available():
        print("benchmarks.fleet_gpu: torch sees no GPU here; nothing was measured", file=sys.stderr)
        return 2
    device = torch.device(asked.device)
    entries: list[Entry] = []
    for n_runs in asked.runs:
        for n_envs in asked.envs:
            entries += update_entries(n_runs, n_envs, device, asked.seconds)
            print(f"fleet_gpu: {entries[-2].name}: {entries[-2].value:,.0f} {entries[-2].unit}", flush=True)
    for n_envs in asked.envs:
        entries += segment_entries(max(asked.runs), n_envs, asked.device, asked.environments, asked.seconds)
        print(f"fleet_gpu: {entries[-1].name}: {entries[-1].value:,.0f} {entries[-1].unit}", flush=True)
    show(entries)
    name = torch.cuda.get_device_name() if asked.device == "cuda" else "the processor"
    Console(highlight=False).print(f"device: {name}; torch {torch.__version__}; {available_cores()} cores")
    folder = Path(os.environ.get("OTR_RESULTS_DIR", "results")) / "benchmarks"
    folder.mkdir(parents=True, exist_ok=True)
    words = ["python", "-m", "benchmarks.fleet_gpu", *(sys.argv[1:] if arguments is None else arguments)]
    suffix = "" if asked.device == "cuda" else "_cpu"
    rows = [entry | {"device": name} for entry in document(entries, words)]
    write_json(folder / f"fleet_gpu{suffix}.json", rows)
    return 0


def update_entries(n_runs: int, n_envs: int, device: torch.device, seconds: float) -> list[Entry]:
    """Return updates/s of all runs together, and the share of the wall time in which the device worked."""
    with tempfile.TemporaryDirectory() as folder:
        capacity = 100_000
        files = [np.memmap(Path(folder) / str(r), np.float32, "w+", shape=(capacity, HOPPER_LAYOUT.width))
                 for r in range(n_runs)]  # fmt: skip
        generator = np.random.default_rng(0)
        for file in files:
            file[:] = generator.standard_normal(file.shape, dtype=np.float32)
        replay = FleetReplay(files, HOPPER_LAYOUT, capacity, device)
        learner = FleetSac(Shapes(11, 3, (6,), (256, 256), 100), [RunSettings(1e-3, 0.99)] * n_runs, device)
        for run in range(n_runs):
            learner.initialise(run, torch.Generator().manual_seed(run))
        updates = Updates(learner, replay)
        positions = torch.randint(capacity, (n_runs, n_envs, 100), device=device)
        noise = torch.randn(n_runs, n_envs, 200, 3, device=device)

        def call() -> None:
            updates(positions, noise)

        for _ in range(EAGER_CALLS + 2):
            call()
        rate, busy = timed(call, device, seconds)
    name = f"updates, R = {n_runs}, E = {n_envs}"
    return [
        Entry(name, rate * n_envs * n_runs, "updates/s", clock="wall"),
        Entry(f"{name}: device at work", busy, "of the time", clock="wall"),
    ]


def timed(call: Callable[[], None], device: torch.device, seconds: float) -> tuple[float, float]:
    """Return calls per second of wall time, and the share of it that the device was at work."""
    if device.type == "cpu":
        began, n_calls = time.perf_counter(), 0
        while time.perf_counter() - began < seconds:
            call()
            n_calls += 1
        return n_calls / (time.perf_counter() - began), 1.0
    start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    torch.cuda.synchronize()
    began, n_calls, at_work = time.perf_counter(), 0, 0.0
    while time.perf_counter() - began < seconds:
        start.record()
        for _ in range(20):
            call()
        end.record()
        end.synchronize()
        at_work += start.elapsed_time(end) / 1000
        n_calls += 20
    elapsed = time.perf_counter() - began
    return n_calls / elapsed, min(1.0, at_work / elapsed)


def segment_entries(n_runs: int, n_envs: int, device: str, environments: str, seconds: float) -> list[Entry]:
    """Return a training segment's speed, its parts, and the time of the table that it gives."""
    name = f"training, R = {n_runs}, E = {n_envs}"
    with tempfile.TemporaryDirectory() as folder:
        n_random = THESIS_SAC.learning_starts

        def trained_s(n_steps: int, first_update: int) -> float:
            configs = [
                run_config(seed, n_steps, first_update, n_envs, device, environments, folder) for seed in range(n_runs)
            ]
            task = Task.of(configs[0])
            trainer = FleetTrainer(task, [FleetRun(config, task.layout) for config in configs])
            with closing(trainer):
                began = time.perf_counter()
                trainer.train_segment(FleetProgress(trainer.runs))
                if device == "cuda":
                    torch.cuda.synchronize()
                return time.perf_counter() - began

        probe = trained_s(n_random + 8 * n_envs, n_random)
        n_steps = max(16 * n_envs, int(seconds / max(probe, 1e-3) * (n_random + 8 * n_envs)))
        with_updates = trained_s(n_random + n_steps, n_random) - trained_s(n_random, n_random)
        without = trained_s(n_random + n_steps, n_random + n_steps) - trained_s(n_random, n_random)
    rate = n_steps / max(with_updates, 1e-9)
    physics = 1 / physics_rate(n_runs * n_envs, environments, min(seconds, 3.0)) * n_runs
    whole = with_updates / n_steps
    hours = STEPS_OF_A_RUN / rate / 3600
    rows = RUNS_OF_A_ROW / n_runs
    entries = [
        Entry(name, rate * n_runs, "steps/s of all runs", clock="wall"),
        Entry(f"{name}: physics alone", physics / whole, "of the time", clock="wall"),
        Entry(f"{name}: acting, copies, random numbers", max(0.0, without / n_steps - physics) / whole, "of the time",
              clock="wall"),
        Entry(f"{name}: updates beyond those", max(0.0, whole - without / n_steps) / whole, "of the time",
              clock="wall"),
        Entry(f"{name}: {RUNS_OF_A_ROW} runs x 4M steps of Hopper", hours * rows * 60, "minutes",
              target="value <= 35" if device == "cuda" else None, clock="wall"),
        Entry(f"{name}: the {SAC_ROWS} SAC rows of Table 4.1 at this speed", hours * rows * SAC_ROWS, "hours",
              clock="wall"),
    ]  # fmt: skip
    return entries


def physics_rate(n: int, environments: str, seconds: float) -> float:
    """Return environment steps/s of `n` hoppers on all cores, with random actions and nothing else."""
    env = make_vector_env(HOPPER, n, backend=environments, n_workers=available_cores())
    actions = np.random.default_rng(0).uniform(-1, 1, (n, 3)).astype(np.float32)
    try:
        env.reset(list(range(n)))
        for _ in range(20):
            env.step(actions)
        began, n_steps = time.perf_counter(), 0
        while time.perf_counter() - began < seconds:
            env.step(actions)
            n_steps += n
        return n_steps / (time.perf_counter() - began)
    finally:
        env.close()


def run_config(
    seed: int, n_steps: int, first_update: int, n_envs: int, device: str, environments: str, folder: str
) -> RunConfig:
    """Return the configuration of one segment of a Hopper run, built without Hydra."""
    return RunConfig(
        env=HOPPER,
        algo=dataclasses.replace(THESIS_SAC, learning_starts=first_update),
        method=MappedConfig("otr"),
        budget=BudgetConfig("benchmark", {}, n_steps, 10, 1, 1, first_update),
        depth=6,
        seed=seed,
        actor=ActorConfig(),
        train=TrainConfig(n_steps, n_steps, 10, first_update),
        map=MapConfig(1024),
        prune=PruneConfig(1, None),
        evaluate=EvaluateConfig(1, 1000),
        results_dir=folder,
        trainer=FleetConfig("fleet", n_envs, "fp32", environments, device, 40),
    )


if __name__ == "__main__":
    sys.exit(main())
