"""Runs the commands as a user does, and gives tests a small configuration."""

import dataclasses
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipelines import cli
from pipelines.config import (
    ActorConfig,
    BudgetConfig,
    EnvConfig,
    EvaluateConfig,
    MapConfig,
    MethodConfig,
    PpoConfig,
    PruneConfig,
    RunConfig,
    SacConfig,
    TrainConfig,
)

PENDULUM = EnvConfig("pendulum", "pendulum", "Pendulum-v1", {}, ["cos_angle", "sin_angle", "angle_rate"], ["torque"])
LANDER = EnvConfig("lunarlander", "lunarlander", "LunarLander-v3")
HOPPER = EnvConfig("hopper", "hopper", "Hopper-v4")
SAC = SacConfig("sac", 1e-3, 32, 0.99, [16], 0.0, 1_000_000, 100, 0.005, 1, 1, "normal", 0.1, 0.01, "auto")
PPO = PpoConfig("ppo", 3e-4, 32, 0.99, [16], 0.0, 2, 64, 0.95, 2, 0.2, 0.0, 0.5, 0.5)


@pytest.fixture
def tiny(tmp_path: Path) -> Callable[..., RunConfig]:
    """Return a function that makes a run of seconds below tmp_path; keyword arguments replace its parts."""

    def make(**changes: object) -> RunConfig:
        base = RunConfig(
            env=PENDULUM,
            algo=SAC,
            method=MethodConfig("otr"),
            budget=BudgetConfig("smoke", {"pendulum": 300}, 100, 2, 2, 3, 100),
            depth=4,
            seed=0,
            actor=ActorConfig(0.0),
            train=TrainConfig(300, 100, 2, 100),
            map=MapConfig(1024),
            prune=PruneConfig(2, None),
            evaluate=EvaluateConfig(3, 1000),
            results_dir=str(tmp_path / "results"),
            n_workers=1,
        )
        return dataclasses.replace(base, **changes)

    return make


def otr_command(program: str, *words: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run one of the installed commands and return what it printed."""
    executable = Path(sys.executable).with_name(program)
    return subprocess.run(
        [str(executable), *words],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )


@dataclass
class Done:
    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def command(monkeypatch, capsys):
    """Return what gives a command in this process, which spares the seconds of starting another."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)

    def run(program: str, *words: str) -> Done:
        monkeypatch.setattr(sys, "argv", [f"otr-{program}", *words])
        try:
            getattr(cli, program)()
        except SystemExit as stopped:
            return Done(stopped.code or 0, *capsys.readouterr())
        raise AssertionError("a command ends with an exit code")

    return run
