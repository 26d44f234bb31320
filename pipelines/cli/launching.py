"""Tasks that are composed already, handed to one of Hydra's launchers, one process each.

`pipelines/cli/sweeps.py` makes the tasks, callables with a group of jobs each. A launcher's processes may be on other
machines that share the file system, so every task is pickled into a file below results_dir and called from there. These
pickles are internal: a sweep writes them, its own processes read them, and they are deleted when it is over (what a
killed one leaves stays); they are never published, and none is read that comes from elsewhere.
"""

import copy
import os
import pickle
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra._internal.callbacks import Callbacks
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.types import HydraContext
from omegaconf import DictConfig

from pipelines.engine.sweep import GroupTask
from pipelines.errors import ConfigError


def launch(tasks: Sequence[GroupTask], config: DictConfig) -> list[Any]:
    """Return what the tasks return, in their order; their argument says whether others run, too.

    Hydra's own sweeper would compose the jobs once more. `config` is that of the sweep, with Hydra's settings.
    """
    settings = config.hydra
    outlives = "submitit_folder" in settings.launcher  # jobs that are queued go on where this process is stopped
    sweep_dir = Path(str(settings.sweep.dir))
    sweep_dir.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="tasks-", dir=sweep_dir))
    is_over = False
    try:
        for number, task in enumerate(tasks):
            (folder / str(number)).write_bytes(pickle.dumps(task))
        name = settings.runtime.choices["hydra/launcher"]
        call = _CallPickled(str(folder), name != "basic", os.getpid() if name == "joblib" else None)
        if settings.launcher.get("backend") == "dask":
            return _by_dask(call, len(tasks))
        loader: Any = _AsComposed()
        context = HydraContext(config_loader=loader, callbacks=Callbacks(config))
        launcher = Plugins.instance().instantiate_launcher(context, call, config)
        if outlives:
            n_jobs = sum(len(task.jobs) for task in tasks)
            place = f"{config.results_dir}/sweeps/.submitit"
            print(f"{n_jobs} jobs handed over; what they print: {place}", flush=True)
        returned = launcher.launch([[] for _ in tasks], initial_job_idx=0)
        results = [result.return_value for result in returned]
        is_over = True
        return results
    finally:
        if is_over or not outlives:
            shutil.rmtree(folder, ignore_errors=True)


class _AsComposed:
    """Gives every process the configuration of the sweep as it is, where Hydra's own loader would compose it again."""

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        return copy.deepcopy(master_config)


@dataclass(frozen=True)
class _CallPickled:
    """Calls the task of the process that it is in; the launcher numbers the processes.

    A process of joblib's whose `parent` was killed ends with its task, and does not wait for another for ever. The
    parent itself does the tasks where joblib has one process.
    """

    folder: str
    side_by_side: bool
    parent: int | None

    def __call__(self, config: DictConfig) -> Any:
        result = self.do(HydraConfig.get().job.num)
        if self.parent not in (None, os.getpid(), os.getppid()):
            os._exit(0)
        return result

    def do(self, number: int) -> Any:
        task: GroupTask = pickle.loads((Path(self.folder) / str(number)).read_bytes())
        return task(self.side_by_side)


def _by_dask(call: _CallPickled, n_tasks: int) -> list[Any]:
    """Return what the tasks return, done by the workers of the cluster at DASK_SCHEDULER_ADDRESS.

    Hydra's launcher takes joblib's own processes whatever its `backend` says. All tasks go to the scheduler at once, so
    that workers that join later have their share.
    """
    from distributed import Client
    from joblib import Parallel, delayed, parallel_config

    address = os.environ.get("DASK_SCHEDULER_ADDRESS")
    if not address:
        raise ConfigError(
            "launcher=dask: DASK_SCHEDULER_ADDRESS is not set. Start `dask scheduler`, and on every node `dask worker "
            "tcp://HOST:8786 --nworkers N --nthreads 1`, then export DASK_SCHEDULER_ADDRESS=tcp://HOST:8786"
        )
    try:
        client = Client(address)
    except OSError as error:
        raise ConfigError(f"launcher=dask: no scheduler answers at {address} ({error})") from error
    with client, parallel_config("dask", client=client):
        results: list[Any] = Parallel(batch_size=1, pre_dispatch="all")(delayed(call.do)(i) for i in range(n_tasks))
    return results
