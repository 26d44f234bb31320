"""Which modules may load torch: importing the library or any stage but train does not."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "modules", ["otr", "pipelines.stages, pipelines.tabulate, pipelines.replay, pipelines.plan", "pipelines.cli"]
)
def test_torch_is_not_loaded(modules):
    code = f"import {modules}, sys; print([m for m in ('torch', 'stable_baselines3', 'sklearn') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
