"""A Dask cluster of two workers: the same bytes as in one process, and a worker killed."""

import os
import signal
import subprocess
import sys

import pytest

from tests.pipelines.conftest import otr_command
from tests.pipelines.sweeps import STAGES, THREE, digests, start, wait_for

pytestmark = pytest.mark.slow

CLUSTER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, memory_limit=0) as cluster:
        print("cluster", cluster.scheduler_address, *[each.pid for each in cluster.workers.values()], flush=True)
        sys.stdin.readline()
"""


@pytest.fixture
def cluster(tmp_path):
    """Return the address of a cluster of two processes, their ids, and the file that has what its jobs print."""
    pytest.importorskip("distributed", reason="the extra dask is not installed; make test-all installs it")
    (tmp_path / "cluster.py").write_text(CLUSTER)
    with (
        (tmp_path / "printed.txt").open("w") as printed,
        subprocess.Popen(
            [sys.executable, "cluster.py"], cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=printed,
            text=True,
        ) as process,
    ):  # fmt: skip
        address, *pids = next(line for line in process.stdout if line.startswith("cluster ")).split()[1:]
        yield address, [int(pid) for pid in pids]
        process.communicate("quit\n", timeout=60)


def test_two_workers_do_the_same_and_one_is_killed(cluster, tmp_path):
    address, (victim, _) = cluster
    basic = start(*THREE, "results_dir=basic", cwd=tmp_path)
    assert basic.wait(timeout=900) == 0
    expected = digests(tmp_path / "basic")

    words = (*THREE, "launcher=dask", "results_dir=dask")
    with start(*words, cwd=tmp_path, DASK_SCHEDULER_ADDRESS=address) as sweep:
        wait_for(lambda: len(list((tmp_path / "dask").glob("checkpoints/*/segment-*"))) == 2)  # both are at a job
        os.kill(victim, signal.SIGKILL)
        printed, _ = sweep.communicate(timeout=900)
    assert sweep.returncode == 0, printed
    assert "3 jobs: 3 done, 0 failed" in printed
    assert len(expected) >= 3 * len(STAGES) and digests(tmp_path / "dask") == expected
    assert not any((tmp_path / "dask/sweeps").iterdir())


def test_a_cluster_is_named_by_its_address(tmp_path):
    pytest.importorskip("distributed", reason="the extra dask is not installed; make test-all installs it")
    for address, message in (("", "DASK_SCHEDULER_ADDRESS is not set"), ("tcp://127.0.0.1:1", "no scheduler answers")):
        environment = {"DASK_SCHEDULER_ADDRESS": address, "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "1s"}
        done = otr_command("otr-run", *THREE, "launcher=dask", cwd=tmp_path, **environment)
        assert done.returncode == 2 and message in done.stderr
