"""Which modules may load torch: importing the library or any stage but train does not. Nor is matplotlib loaded."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "modules", ["otr", "pipelines.stages, pipelines.tabulate, pipelines.replay, pipelines.plan", "pipelines.cli"]
)
def test_torch_and_matplotlib_are_not_loaded(modules):
    heavy = ("torch", "stable_baselines3", "sklearn", "matplotlib")
    code = f"import {modules}, sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
