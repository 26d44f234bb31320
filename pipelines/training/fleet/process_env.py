"""gymnasium's environments over several processes, each of which steps its share one after the other."""

import itertools
import multiprocessing
import signal
import traceback
from collections.abc import Sequence
from ctypes import c_byte
from multiprocessing.connection import Connection
from typing import Any, NoReturn

import numpy as np

from pipelines.config import EnvConfig
from pipelines.errors import ConfigError, PipelineError
from pipelines.training.fleet.vector_environments import GymnasiumVectorEnv, Step, VectorEnv, check_actions, check_seeds

RESET, STEP, DONE = b"reset", b"step", b"done"


class ProcessVectorEnv(VectorEnv):
    """Environments split over `n_workers` processes; the same trajectories as in one.

    A process steps a share of the environments, not one as in `AsyncVectorEnv`, and arrays go through shared memory:
    two workers on one core step ten hoppers at 77 % of the speed of one process, `AsyncVectorEnv` at 34 %.
    """

    def __init__(self, env: EnvConfig, n_envs: int, *, n_workers: int, rescale_inputs: bool = False) -> None:
        if not 1 <= n_workers <= n_envs:
            raise ConfigError(f"{n_workers} processes for {n_envs} environments: use 1 to {n_envs}")
        shape = _shape(env, n_envs, rescale_inputs)  # also tells what is wrong with the request before a process starts
        self.n_envs = n_envs
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        bounds = np.linspace(0, n_envs, n_workers + 1).round().astype(int).tolist()
        self._shares = [slice(start, end) for start, end in itertools.pairwise(bounds)]
        context = multiprocessing.get_context("spawn")
        memory = context.RawArray(c_byte, _record(*shape).itemsize)
        self._arrays = _arrays(memory, shape)
        # Workers inherit the mask: Ctrl-C reaches this process alone, which ends them.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            for share in self._shares:
                pipe, theirs = context.Pipe()
                arguments = (theirs, memory, shape, share, env, rescale_inputs)
                process = context.Process(target=_work, args=arguments, daemon=True)
                process.start()
                theirs.close()  # so that the pipe ends when the worker does
                self._pipes.append(pipe)
                self._processes.append(process)
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        self._wait()

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        check_seeds(seeds, self.n_envs)
        self._arrays["seeds"][:] = seeds
        self._tell(RESET)
        self._wait()
        return self._arrays["states"].copy()

    def send(self, actions: np.ndarray) -> None:
        check_actions(actions, self.n_envs)
        self._arrays["actions"][:] = actions
        self._tell(STEP)

    def receive(self) -> Step:
        self._wait()
        return Step(*(self._arrays[name].copy() for name in Step._fields))

    def close(self) -> None:
        for pipe in self._pipes:
            pipe.close()  # a worker ends when its pipe does
        for process in self._processes:
            process.join(timeout=5)
            if process.is_alive():
                process.terminate()
                process.join()
        self._pipes, self._processes = [], []

    def _tell(self, task: bytes) -> None:
        for worker, pipe in enumerate(self._pipes):
            try:
                pipe.send_bytes(task)
            except OSError:
                self._give_up(worker)

    def _wait(self) -> None:
        """Wait until every worker has done what it was told; raise the first one's error."""
        for worker, pipe in enumerate(self._pipes):
            try:
                answer = pipe.recv_bytes()
            except (EOFError, OSError):
                self._give_up(worker)
            if answer != DONE:
                self.close()
                raise PipelineError(answer.decode())

    def _give_up(self, worker: int) -> NoReturn:
        process, share = self._processes[worker], self._shares[worker]
        process.join(timeout=5)
        self.close()
        raise PipelineError(
            f"the process of environments {share.start} to {share.stop - 1} ended with exit code {process.exitcode}; "
            "run the same command again to resume"
        )


def _work(
    pipe: Connection, memory: Any, shape: tuple[int, int, int], share: slice, env: EnvConfig, rescale_inputs: bool
) -> None:
    """Do what the pipe tells until it ends; the first answer says that the environments are made."""
    try:
        mine = {name: array[share] for name, array in _arrays(memory, shape).items()}
        envs = GymnasiumVectorEnv(env, share.stop - share.start, rescale_inputs=rescale_inputs)
        pipe.send_bytes(DONE)
        while True:
            if pipe.recv_bytes() == RESET:
                mine["states"][:] = envs.reset(mine["seeds"].tolist())
            else:
                for name, value in envs.step(mine["actions"])._asdict().items():
                    mine[name][:] = value
            pipe.send_bytes(DONE)
    except (EOFError, ConnectionError):
        return
    except Exception:
        where = f"environments {share.start} to {share.stop - 1}"
        pipe.send_bytes(f"the process of {where} failed:\n{traceback.format_exc()}".encode())


def _shape(env: EnvConfig, n_envs: int, rescale_inputs: bool) -> tuple[int, int, int]:
    """Return the numbers of environments, of state components and of action components."""
    one = GymnasiumVectorEnv(env, 1, rescale_inputs=rescale_inputs)
    one.close()
    return n_envs, one.n_state_components, one.n_action_components


def _arrays(memory: Any, shape: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """Return the shared arrays by name, as views of the memory."""
    mapped = np.frombuffer(memory, _record(*shape))
    return {name: mapped[name][0] for name in mapped.dtype.names or ()}


def _record(n: int, d: int, a: int) -> np.dtype:
    return np.dtype(
        [
            ("seeds", np.int64, (n,)),
            ("actions", np.float32, (n, a)),
            ("next_states", np.float32, (n, d)),
            ("rewards", np.float32, (n,)),
            ("states", np.float32, (n, d)),
            ("terminated", np.bool_, (n,)),
            ("truncated", np.bool_, (n,)),
        ],
        align=True,
    )
