"""The updates after a vector step: on the processor one after the other, on a GPU as one captured graph."""

import torch
from torch import Tensor

from pipelines.training.fleet.replay_buffer import FleetReplay
from pipelines.training.fleet.sac import FleetSac

EAGER_CALLS = 3  # on a GPU, before the capture: libraries allocate their workspaces in them


class Updates:
    """E updates of every run.

    On a GPU they are captured as one graph once and replayed from then on, without synchronisation: what a call is
    given is copied into the graph's own inputs, and the processor goes on while the device works.
    """

    def __init__(self, learner: FleetSac, replay: FleetReplay) -> None:
        self._learner, self._replay = learner, replay
        self._graph: torch.cuda.CUDAGraph | None = None
        self._inputs: tuple[Tensor, Tensor] | None = None
        self._n_calls = 0

    def __call__(self, positions: Tensor, noise: Tensor) -> None:
        """Do the updates.

        Args:
            positions: (R, E, B), rows of the replay buffers.
            noise: (R, E, 2 B, n_actions), standard normal.
        """
        self._n_calls += 1
        if positions.device.type == "cpu":
            self._all(positions, noise)
            return
        stream = torch.cuda.current_stream()
        if self._n_calls <= EAGER_CALLS:
            self._all(positions, noise)
            return
        if self._graph is None or self._inputs is None:
            self._inputs = positions.clone(), noise.clone()
            self._graph = torch.cuda.CUDAGraph()
            stream.synchronize()
            with torch.cuda.graph(self._graph):  # records, does not run
                self._all(*self._inputs)
        self._inputs[0].copy_(positions)
        self._inputs[1].copy_(noise)
        self._graph.replay()

    def _all(self, positions: Tensor, noise: Tensor) -> None:
        for e in range(positions.shape[1]):
            self._learner.update(self._replay.gather(positions[:, e]), noise[:, e])
