"""Runs the commands as a user does, and gives tests a small configuration."""

import contextlib
import dataclasses
import io
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipelines import cli
from pipelines.config.algo import ArsConfig, PpoConfig, SacConfig
from pipelines.config.budget import BudgetConfig
from pipelines.config.env import EnvConfig
from pipelines.config.hardened_methods import PiPrlConfig
from pipelines.config.methods import MappedConfig
from pipelines.config.run import RunConfig
from pipelines.config.stages import ActorConfig, EvaluateConfig, MapConfig, PruneConfig, TrainConfig

PENDULUM = EnvConfig("pendulum", "pendulum", "Pendulum-v1", {}, ["cos_angle", "sin_angle", "angle_rate"], ["torque"])
LANDER = EnvConfig("lunarlander", "lunarlander", "LunarLander-v3")
HOPPER = EnvConfig("hopper", "hopper", "Hopper-v4")
SAC = SacConfig("sac", 1e-3, 32, 0.99, [16], 0.0, 1_000_000, 100, 0.005, 1, 1, "normal", 0.1, 0.01, "auto")
PI_PRL = PiPrlConfig(
    "pi_prl",
    beta_first=1.0,
    beta_last=16.0,
    anneal_until=0.5,
    learning_rate_end=0.2,
    structure_penalty=0.25,
    discretise_at=0.75,
)
ARS = ArsConfig("ars", 4, 2, 0.1, 0.1, 0.5, 0.5, 0.0, 1, "pair", True, 0.0, 0, 1.0, 1, 1, "gymnasium", 8_000.0)
PPO = PpoConfig("ppo", 3e-4, 32, 0.99, [16], 0.0, 2, 64, 0.95, 2, 0.2, 0.0, 0.5, 0.5)


@pytest.fixture
def tiny(tmp_path: Path) -> Callable[..., RunConfig]:
    """Return a function that makes a run of seconds below tmp_path; keyword arguments replace its parts."""

    def make(**changes: object) -> RunConfig:
        base = RunConfig(
            env=PENDULUM,
            algo=SAC,
            method=MappedConfig("otr"),
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


def otr_program(program: str, *words: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run one of the installed commands in a process of its own and return what it printed."""
    command = [str(Path(sys.executable).with_name(program)), *words]
    environment = {**os.environ, **environment}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


@dataclass
class Done:
    returncode: int
    stdout: str
    stderr: str


def otr_command(program: str, *words: str, cwd: Path, **environment: str) -> Done:
    """Do the same in this process, which spares the seconds in which another would import torch."""
    stdout, stderr = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(stdout),
        contextlib.redirect_stderr(stderr),
        pytest.raises(SystemExit) as ended,
    ):
        patch.setattr(signal, "signal", lambda *_: None)
        patch.setattr(sys, "argv", [program, *words])
        patch.chdir(cwd)
        for name, value in environment.items():
            patch.setenv(name, value)
        getattr(cli, program.removeprefix("otr-"))()
    code = ended.value.code
    assert code is None or isinstance(code, int)
    return Done(code or 0, stdout.getvalue(), stderr.getvalue())


def otr_succeeds(program: str, *words: str, cwd: Path, **environment: str) -> Done:
    done = otr_command(program, *words, cwd=cwd, **environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture
def command() -> Callable[..., Done]:
    """Return what gives a command, without its "otr-", in this process and folder."""
    return lambda program, *words: otr_command(f"otr-{program}", *words, cwd=Path.cwd())
