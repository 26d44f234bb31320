"""Which modules load torch: importing the library or any stage but train does not, nor pandas, matplotlib or onnx."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "modules",
    [
        "otr",
        "pipelines.datasets.command, pipelines.report.tabulate",
        "pipelines.runs.stage_table, pipelines.report.tabulate, pipelines.runs.replay, pipelines.runs.plan",
        ", ".join(f"pipelines.cli.commands.{name}" for name in ("run", "plan", "fit", "tabulate", "export", "verify")),
    ],
)
def test_heavy_packages_are_not_loaded(modules):
    heavy = ["torch", "stable_baselines3", "sklearn", "matplotlib", "onnx"]
    heavy += [] if "tabulate" in modules else ["pandas"]
    heavy += ["hydra", "omegaconf"] if "datasets" in modules else []
    code = f"import {modules}, sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
