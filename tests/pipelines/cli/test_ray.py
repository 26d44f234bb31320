"""A Ray cluster of two nodes, in an environment of its own: the same bytes as in one process, and a node killed."""

import os
import signal
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.pipelines.sweeps import STAGES, THREE, children, digests, start, times_made, wait_for

ROOT = Path(__file__).parents[3]
PACKAGES = ("ray==2.60.0", "hydra-ray-launcher==1.2.2", "joblib<1.6")  # what otr[ray] comes to
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes under /proc"),
]

CLUSTER = """
import sys
from ray.cluster_utils import Cluster
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
node = cluster.add_node(num_cpus=1)
cluster.wait_for_nodes()
print("cluster", cluster.address, node.all_processes["raylet"][0].process.pid, flush=True)
sys.stdin.readline()
cluster.shutdown()
"""


@pytest.fixture
def python(tmp_path):
    """The Python of an environment with Ray and the packages that its plugin wants; the rest comes from ours."""
    folder = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True, timeout=900)
    python = folder / "bin" / "python"
    constraints = tmp_path / "constraints.txt"
    pins = (ROOT / "constraints.txt").read_text().splitlines()
    constraints.write_text("\n".join(pin for pin in pins if not pin.startswith(("cloudpickle==", "joblib=="))))
    install = [str(python), "-m", "pip", "install", "--quiet", "-c", str(constraints), *PACKAGES]
    subprocess.run(install, check=True, timeout=1200)
    (site,) = folder.glob("lib/python*/site-packages")
    (site / "ours.pth").write_text(f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n")
    return str(python)


@pytest.fixture
def cluster(python, monkeypatch):
    """The address of a cluster of two nodes with one core each, and the process of the second."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_DEDUP_LOGS", "0")
    with subprocess.Popen(
        [python, "-c", CLUSTER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=dict(os.environ)
    ) as process:
        line = next(line for line in process.stdout if line.startswith("cluster "))
        _, address, raylet = line.split()
        yield address, int(raylet)
        process.communicate("quit\n", timeout=120)


def test_two_nodes_do_the_same_and_one_is_killed(python, cluster, tmp_path):
    address, raylet = cluster
    basic = start(*THREE, "results_dir=basic", cwd=tmp_path)
    assert basic.wait(timeout=900) == 0
    expected = digests(tmp_path / "basic")

    sweep = start(*THREE, "launcher=ray", "results_dir=ray", cwd=tmp_path, python=python, RAY_ADDRESS=address)
    printed, _ = sweep.communicate(timeout=900)
    assert sweep.returncode == 0, printed
    assert "3 jobs: 3 done, 0 failed" in printed
    assert len(expected) == 36 and digests(tmp_path / "ray") == expected

    words = (*THREE, "train.steps=1500", "train.eval_interval_steps=300", "launcher=ray", "results_dir=killed")
    results = tmp_path / "killed"
    with start(*words, cwd=tmp_path, python=python, RAY_ADDRESS=address) as sweep:
        wait_for(lambda: len(list(results.glob("checkpoints/*/segment-*"))) == 2)
        finished = {path: path.stat().st_mtime_ns for path in results.glob("runs/**/manifest.json")}
        victims = [raylet, *children(raylet)]
        assert len(victims) > 1
        for pid in victims:
            os.kill(pid, signal.SIGKILL)
        printed, _ = sweep.communicate(timeout=900)
    assert sweep.returncode == 0, printed
    assert "3 jobs: 3 done, 0 failed" in printed
    assert "train: going on from step" in printed
    assert len(list(results.glob("runs/**/summary.json"))) == 3
    assert {path: path.stat().st_mtime_ns for path in finished} == finished
    assert max(times_made(printed.replace("\x1b[0m ", "\n")).values()) <= 3
    assert printed.count("step 1,500/1,500") == 3
    assert len(STAGES) * 3 == len(list(results.glob("runs/**/manifest.json")))
