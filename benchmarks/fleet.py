"""The fleet trainer on one core: environment steps a second against Stable-Baselines3, SBX and the arithmetic floor.

Everything is the real thing: Hopper, an actor of 6 neurons, critics [256, 256], batches of 100 (conf/algo/sac.yaml),
physics, replay and updates included, evaluations and checkpoints left out on all sides. Ten runs train as the product
would train them, in fleets of `runs_per_process`. The peers train one run. All take turns, round after round, and of
each the fastest round counts.

The floor is the time of the float32 matrix products alone that an update needs, of five runs in the shapes that occur
and in stacks like theirs, without a single addition, activation, transition or environment step.

So do fleets whose actors are pi-PRL's relaxed programs of depth 6, against one run of such a program under
Stable-Baselines3, as `trainer=sb3` trains it, and against the networks' fleets.

Targets: 2.2 times the peer, 0.6 of the floor, faster than SBX; programs 2.2 times their peer and 0.7 of the networks.

SBX (Stable-Baselines3 in JAX) needs packages of its own: it is measured where OTR_SBX_PYTHON names the python of an
environment that has `sbx-rl`, `gymnasium[mujoco]` and nothing of ours; `benchmarks/sbx_peer.py` runs there.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from benchmarks.measure import Entry, alternate
from benchmarks.training import plain_trainer
from otr.control.sac.actors import ModuleActors
from otr.control.sac.adam import RunSettings
from otr.control.sac.sac import FleetSac, Minibatch, Shapes
from otr.control.sac.stacked_tensors import multiply, new_stack
from pipelines.cli import runs
from pipelines.config.run import RunConfig
from pipelines.runs.fleets import fleets
from pipelines.training.fleet.fleet_run import FleetRun
from pipelines.training.fleet.progress import FleetProgress
from pipelines.training.fleet.trainer import FleetTrainer, Task
from pipelines.training.progress import TrainingProgress
from pipelines.training.sb3.actor_kinds import actor_of
from pipelines.training.sb3.models import build_model
from pipelines.training.sb3.training import train_segment

N_RUNS = 10
N_RANDOM = 100
PROGRAMS = ("method=pi_prl", "algo=sac")
PEER_STEPS_AHEAD = 300  # SBX compiles in its first steps


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick trains shorter segments, twice instead of twelve times."""
    rounds, n_steps = (2, 150) if quick else (12, 250)
    sbx = os.environ.get("OTR_SBX_PYTHON")
    sides: dict[str, Callable[[], float]] = {
        "sb3": peer_rate(n_steps),
        "fp32": fleet_rate(n_steps),
        "programs": fleet_rate(n_steps, *PROGRAMS),
        "sb3 program": program_peer_rate(n_steps),
    }
    if sbx:
        sides["sbx"] = lambda: sbx_rate(sbx, 5 * n_steps)
    best = dict.fromkeys(sides, 0.0)
    floor = float("inf")
    for i in range(rounds):
        for name, side in sides.items():
            best[name] = max(best[name], side())
        floor = min(floor, floor_seconds())
        rates = ", ".join(f"{name} {rate:,.0f}" for name, rate in best.items())
        print(f"fleet: round {i + 1} of {rounds}, steps/s: {rates}; floor {1 / floor:,.0f} updates/s", flush=True)
    ours = f"Hopper, {N_RUNS} runs on one core"
    sb3, unit = "Stable-Baselines3 SAC, one run", "steps/s"
    entries = [
        Entry(f"{ours}, fp32", best["fp32"], unit, sb3, best["sb3"], "ratio >= 2.2"),
        Entry(
            f"{ours}, fp32, of the arithmetic floor",
            best["fp32"],
            unit,
            "its products alone",
            1 / floor,
            "ratio >= 0.6",
        ),
        Entry(
            f"{ours}, fp32, programs", best["programs"], unit, f"{sb3}, program", best["sb3 program"], "ratio >= 2.2"
        ),
        Entry(f"{ours}, fp32, programs", best["programs"], unit, "networks", best["fp32"], "ratio >= 0.7"),
    ]
    if sbx:
        entries.insert(1, Entry(f"{ours}, fp32", best["fp32"], unit, "SBX SAC, one run", best["sbx"], "ratio >= 1"))
    return entries + learner_entries(quick)


def run_config(n_steps: int, *overrides: str) -> RunConfig:
    """Return the configuration of `otr-run env=hopper depth=6 budget=thesis trainer=fleet` and segments so long."""
    own = ["env=hopper", "depth=6", "budget=thesis", "trainer=fleet"]
    own += [f"train.max_learning_starts={N_RANDOM}", f"train.eval_interval_steps={n_steps}"]
    return runs.run_config([*own, *overrides])


def fleet_rate(n_steps: int, *overrides: str) -> Callable[[], float]:
    """Return a function that trains all runs for a segment more and returns environment steps per CPU-second."""
    folder = tempfile.TemporaryDirectory()
    configs = [
        dataclasses.replace(run_config(n_steps, f"seed={seed}", *overrides), results_dir=folder.name)
        for seed in range(N_RUNS)
    ]
    task = Task.of(configs[0])
    runs = [FleetRun(each, Path(folder.name) / str(each.seed), task.layout) for each in configs]
    trainers = [FleetTrainer(task, [runs[i] for i in part]) for part in fleets(configs)]
    quiet = [FleetProgress(trainer.runs) for trainer in trainers]

    def rate() -> float:
        assert folder
        seconds, n_trained = 0.0, 0
        for trainer, progress in zip(trainers, quiet, strict=True):
            began = time.process_time()
            end, _, _ = trainer.train_segment(progress)
            seconds += time.process_time() - began
            for run in trainer.runs:
                n_trained += end - run.n_steps
                run.n_steps = end
        return n_trained / seconds

    rate()  # the random steps are in this one
    return rate


def peer_rate(n_steps: int) -> Callable[[], float]:
    """Return the same for a plain Stable-Baselines3 script."""
    return model_rate(*plain_trainer(run_config(n_steps)))


def program_peer_rate(n_steps: int) -> Callable[[], float]:
    """Return the same for a relaxed program as our trainer by Stable-Baselines3 trains it."""
    config = run_config(n_steps, *PROGRAMS, "trainer=sb3")
    model, actor, progress, segments = build_model(config, 0), actor_of(config), TrainingProgress(config, 0), count()
    return model_rate(model, lambda: train_segment(model, actor, next(segments), progress))


def model_rate(model: BaseAlgorithm, train_on: Callable[[], object]) -> Callable[[], float]:
    """Return the function that trains a model for a segment more and returns environment steps per CPU-second."""

    def rate() -> float:
        start, began = model.num_timesteps, time.process_time()
        train_on()
        return (model.num_timesteps - start) / (time.process_time() - began)

    rate()
    return rate


def sbx_rate(python: str, n_steps: int) -> float:
    """Return SBX's environment steps per CPU-second in a process of its own."""
    algo: Any = run_config(n_steps).algo
    settings = {name: getattr(algo, name) for name in ("learning_rate", "batch_size", "gamma", "tau", "critic")}
    settings |= {"n_steps": n_steps, "n_random": N_RANDOM, "n_ahead": PEER_STEPS_AHEAD}
    script = Path(__file__).with_name("sbx_peer.py")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    answer = subprocess.run(
        [python, str(script), json.dumps(settings)], env=environment, capture_output=True, text=True, check=False
    )
    if answer.returncode:
        sys.stderr.write(answer.stderr)
        raise RuntimeError("SBX could not be measured; unset OTR_SBX_PYTHON to leave it out")
    return float(answer.stdout.split()[-1])


def floor_seconds(n_runs: int = 5, repeats: int = 100) -> float:
    """Return the CPU-seconds a run of an update's matrix products: three forward passes, two backward."""
    n, rows, d_in, width = 2 * n_runs, 100, 14, 256

    def stack(*shape: int) -> torch.Tensor:
        return new_stack(n, *shape).normal_()

    x, h = stack(rows, d_in), stack(rows, width)
    W1, W2, W3 = stack(d_in, width), stack(width, width), stack(width, 1)
    out1, out2, out3 = stack(rows, width), stack(rows, width), stack(rows, 1)
    gradients = [stack(*weight.shape[1:]) for weight in (W1, W2, W3)]
    d_actions = stack(rows, 3)

    def products() -> None:
        for _ in range(3):  # targets; critics on the batch; critics on the policy's actions
            multiply(x, W1, out1)
            multiply(h, W2, out2)
            multiply(h, W3, out3)
        for inputs, delta, gradient in ((x, out1, gradients[0]), (h, out2, gradients[1]), (h, out3, gradients[2])):
            multiply(inputs.transpose(1, 2), delta, gradient)
        for _ in range(2):  # back through the critics, for themselves and for the actions
            multiply(out3, W3.transpose(1, 2), out2)
            multiply(out2, W2.transpose(1, 2), out1)
        multiply(out1, W1[:, 11:].transpose(1, 2), d_actions)

    products()
    return min(alternate(products, rounds=1, repeats=repeats)) / n_runs


def learner_entries(quick: bool) -> list[Entry]:
    """Return updates a second of the learner alone, by how many runs share a process and by the actor's shape."""
    rounds, n_updates = (2, 20) if quick else (5, 60)
    kinds: dict[str, Callable[[], None]] = {}
    n_of: dict[str, int] = {}
    for n_runs, actor in ((1, (6,)), (2, (6,)), (5, (6,)), (10, (6,)), (20, (6,)), (5, (32,)), (5, (256, 256))):
        name = f"learner alone, {n_runs} runs a process, actor {list(actor)}"
        kinds[name], n_of[name] = learner(n_runs, actor), n_runs
    seconds = alternate(*kinds.values(), rounds=rounds, repeats=n_updates)
    entries = [Entry(name, n_of[name] / each, "updates/s") for name, each in zip(kinds, seconds, strict=True)]
    for n_runs in (1, 3, 5):
        pair = learner(n_runs, (6,), as_modules=True), learner(n_runs, (6,))
        modules, by_hand = (n_runs / each for each in alternate(*pair, rounds=rounds, repeats=n_updates))
        name = f"learner alone, {n_runs} runs a process, actor [6], a module"
        entries.append(Entry(name, modules, "updates/s", "by hand", by_hand))
    return entries


def learner(n_runs: int, actor: tuple[int, ...], *, as_modules: bool = False) -> Callable[[], None]:
    """Return a function that does one update of each of `n_runs` runs."""
    settings = [RunSettings(1e-3, 0.99)] * n_runs
    modules = [nn.Sequential(nn.Linear(11, *actor), nn.ReLU(), nn.Linear(*actor, 6)) for _ in settings * as_modules]
    shapes = Shapes(11, 3, actor, (256, 256), 100)
    fleet = FleetSac(shapes, settings, actor=ModuleActors(settings, modules) if modules else None)
    for run in range(n_runs):
        fleet.initialise(run, torch.Generator().manual_seed(run))
    batch = Minibatch(
        torch.randn(n_runs, 100, 11),
        torch.rand(n_runs, 100, 3) * 2 - 1,
        torch.randn(n_runs, 100),
        torch.randn(n_runs, 100, 11),
        torch.ones(n_runs, 100),
    )
    noise = torch.randn(n_runs, 200, 3)

    def update() -> None:
        fleet.update(batch, noise)

    update()
    return update
