"""Slower checks of what people take away: committed policies play again as recorded, the wheel works on its own."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.slow


def test_committed_policies_play_the_recorded_episodes(tmp_path):
    """Of every method the first seeds on the pendulum and the car; `make reproduce-table EVALUATE=1` plays all."""
    runs = ROOT / "results" / "runs"
    for env in ("pendulum", "mountaincar"):
        for run in runs.glob(f"{env}/*/depth-*/quick/seed-0"):
            shutil.copytree(run, tmp_path / "runs" / run.relative_to(runs))
    program = Path(sys.executable).with_name("otr-tabulate")
    command = [str(program), "table=4.1", "evaluate=true", f"results_dir={tmp_path}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=1200)
    summaries = [json.loads(path.read_text()) for path in tmp_path.glob("runs/*/*/*/*/*/summary.json")]
    n_recorded = sum(len(summary["policies"]) for summary in summaries)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("episodes played again, as recorded") == n_recorded > 30


def test_wheel_brings_its_configuration(tmp_path):
    pip, site = [sys.executable, "-m", "pip", "--quiet"], tmp_path / "site"
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", str(tmp_path), str(ROOT)], check=True, timeout=600)
    (wheel,) = tmp_path.glob("otr-*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(site), str(wheel)], check=True, timeout=600)
    code = (
        "import sys; from pipelines import cli; from pipelines.config import conf_dir; "
        "sys.argv = ['otr-run', 'env=pendulum', 'depth=2', 'budget=smoke', "
        f"'n_workers=1']; assert conf_dir.CONF_DIR.is_relative_to({str(site)!r}), conf_dir.CONF_DIR; cli.run()"
    )
    environment = {"PYTHONPATH": str(site), "PATH": "/usr/bin:/bin"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "results/runs/pendulum/otr/depth-2/smoke/seed-0/summary.json").exists()
