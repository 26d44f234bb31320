"""Control: what trees that learn from interaction cost.

The soft tree of depth 6 with affine leaves, forward and backward, against a ReLU network of as many parameters in
torch, once with one hidden layer and once with two; float32, one thread, batches of 64 to 1,024 states. Shapes are the
lander's (8 inputs, 4 outputs), Hopper's (11, 3) and Ant's (27, 8). The relaxed program of pi-PRL has an affine map in
every hole and not in its leaves only, twice as many parameters, and is held against networks of as many.

A run of DAgger on the lander, 50 rounds of 25 episodes with the choice of an iterate, at depth 3, imitating the
committed oracle [256]; the share spent in the environment shows what is left to gain.

Targets: soft tree within 3 times the network's seconds; a run of DAgger within 3 minutes of one core.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import nn

from benchmarks.measure import Entry, alternate, repeats_for
from otr.control import AugTreeFit, CartFit, DaggerSettings, RelaxedProgram, SoftTree, run_dagger
from otr.control.dagger.loop import TreeFit
from pipelines.config.env import EnvConfig
from pipelines.engine.seeding import episode_seeds
from pipelines.play.actor_files import load_actor
from pipelines.play.episodes import Policy, Rollout, play_seeds

torch.set_num_threads(1)

DEPTH = 6
LANDER = EnvConfig("lunarlander", "lunarlander", "LunarLander-v3")
ORACLE = Path(__file__).parents[1] / "results/runs/lunarlander/otr/depth-256/quick/seed-0/train"
SHAPES = {"lander": (8, 4), "hopper": (11, 3), "ant": (27, 8)}


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick measures the lander's shape only, in fewer rounds."""
    torch.manual_seed(0)
    entries = []
    for name, (n_inputs, n_outputs) in SHAPES.items():
        if quick and name != "lander":
            continue
        modules = {
            "soft tree": SoftTree(n_inputs, n_outputs, DEPTH, affine_leaves=True),
            "relaxed program": RelaxedProgram(n_inputs, n_outputs, DEPTH),
        }
        for kind, module in modules.items():
            for n_states in (64, 256, 1_024):
                target = "ratio <= 3" if kind == "soft tree" else None
                entries += _against_networks(f"{kind}, {name}", module, n_states, 4 if quick else 12, target)
        print(f"control: {name} done", flush=True)
    return entries + _dagger_runs(quick)


def relu_network(n_inputs: int, n_outputs: int, n_hidden_layers: int, n_parameters: int) -> nn.Sequential:
    """Return a ReLU network with hidden layers of one width, whose number of parameters is nearest to the one given."""
    # (n_hidden_layers - 1) w^2 + b w + n_outputs = n_parameters
    a, b = n_hidden_layers - 1, n_inputs + n_outputs + n_hidden_layers
    rest = n_parameters - n_outputs
    width = round(rest / b if a == 0 else (math.sqrt(b * b + 4 * a * rest) - b) / (2 * a))
    layers: list[nn.Module] = []
    for layer in range(n_hidden_layers):
        layers += [nn.Linear(n_inputs if layer == 0 else width, width), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(width, n_outputs))


def n_parameters_of(module: nn.Module) -> int:
    """Return the number of trainable parameters."""
    return sum(parameter.numel() for parameter in module.parameters())


def _dagger_runs(quick: bool) -> list[Entry]:
    """Return the seconds of a run for AugTree and VIPER, and the share of them spent playing."""
    settings = DaggerSettings(2, 3, 3, 6) if quick else DaggerSettings()
    oracle = load_actor(ORACLE)
    entries = []
    fits: dict[str, TreeFit] = {"AugTree": AugTreeFit(oracle, 3), "VIPER": CartFit(3)}
    for name, fit in fits.items():
        played_s = 0.0

        def play(policy: Policy, seeds: Sequence[int], keep_states: bool) -> Rollout:
            nonlocal played_s
            began = time.process_time()
            played = play_seeds(policy, LANDER, seeds, keep_states=keep_states, n_workers=1)
            played_s += time.process_time() - began
            return played

        def seeds_of(name: str, index: int, n: int) -> list[int]:
            return episode_seeds(0, "imitate", n, ("oracle", "dagger", "selection").index(name), index)

        with TemporaryDirectory() as folder:
            began = time.process_time()
            result = run_dagger(oracle, fit, play, seeds_of, settings, np.random.SeedSequence(0), Path(folder))
            seconds = time.process_time() - began
        what = f"{name}, lander, depth 3: {settings.n_rounds} rounds of {settings.n_episodes} episodes"
        entries.append(Entry(what, seconds, "s", target="value <= 180"))
        entries.append(Entry(f"{what}: environment steps", result.n_steps, "steps", clock=None))
        entries.append(Entry(f"{what}: of it played", played_s, "s"))
        print(f"control: {name} done", flush=True)
    return entries


def _against_networks(
    what: str, module: SoftTree | RelaxedProgram, n_states: int, rounds: int, target: str | None
) -> list[Entry]:
    """Return the entries of one batch size, against one and two hidden layers."""
    n_parameters = n_parameters_of(module)
    peers = [relu_network(module.n_inputs, module.n_outputs, layers, n_parameters) for layers in (1, 2)]
    X = torch.randn(n_states, module.n_inputs)
    passes = [_forward_and_backward(each, X) for each in (module, *peers)]
    ours, *theirs = alternate(*passes, rounds=rounds, repeats=repeats_for(passes[1], 0.03))
    name = f"{what}: forward and backward, {n_states:,} states"
    return [
        Entry(name, 1e6 * ours, "us", f"ReLU network, {layers} hidden", 1e6 * seconds, target)
        for layers, seconds in zip((1, 2), theirs, strict=True)
    ]


def _forward_and_backward(module: nn.Module, X: torch.Tensor) -> Callable[[], None]:
    parameters = list(module.parameters())

    def run() -> None:
        for parameter in parameters:
            parameter.grad = None
        module(X).sum().backward()

    return run
