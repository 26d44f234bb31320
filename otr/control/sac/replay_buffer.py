"""Replay buffers of R runs: `capacity` rows of float32 each, [state, action, next state, reward, continues].

Transition i of a run is in row i % capacity.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from otr.control.sac.sac import Minibatch


@dataclass(frozen=True)
class RowLayout:
    """Where the parts of a transition are in its row."""

    n_inputs: int
    n_actions: int

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return 2 * self.n_inputs + self.n_actions + 2

    def split(self, rows: Tensor) -> Minibatch:
        """Return views of the parts of rows (R, B, width)."""
        sizes = [self.n_inputs, self.n_actions, self.n_inputs, 1, 1]
        states, actions, next_states, rewards, continues = torch.split(rows, sizes, dim=2)
        return Minibatch(states, actions, rewards[..., 0], next_states, continues[..., 0])


class FleetReplay:
    """The replay buffers of R runs, each with its rows, in memory or of a file, all of one capacity.

    The newest `size` transitions, at most the capacity, can be sampled.
    """

    def __init__(self, files: Sequence[np.ndarray], layout: RowLayout, size: int) -> None:
        self._files, self._layout, self._size = list(files), layout, size
        self.capacity = len(files[0])
        self._rows = [torch.from_numpy(file) for file in files]

    def add(self, start: int, transitions: Tensor) -> None:
        """Write transitions `start`, `start` + 1, ... of every run, (R, E, width)."""
        positions = (start + torch.arange(transitions.shape[1])) % self.capacity
        for rows, new in zip(self._rows, transitions, strict=True):
            rows[positions] = new

    def positions(self, fractions: Tensor, n_transitions: Tensor) -> Tensor:
        """Return the rows that uniform fractions in [0, 1) choose.

        Args:
            fractions: (R, U, B), float64.
            n_transitions: (U,), how many transitions each run has at each of U updates; the newest `size` count.
        """
        counts = n_transitions.view(1, -1, 1)
        sampled = counts.clamp(max=self._size)
        chosen = torch.minimum((fractions * sampled).long(), sampled - 1)  # a product may round up to the whole
        return (chosen + (counts - sampled)) % self.capacity

    def gather(self, positions: Tensor) -> Minibatch:
        """Return the transitions in rows (R, B)."""
        chosen = torch.empty(*positions.shape, self._layout.width)
        for rows, index, out in zip(self._rows, positions, chosen, strict=True):
            torch.index_select(rows, 0, index, out=out)
        return self._layout.split(chosen)

    def flush(self) -> None:
        """Bring the rows to the disk."""
        for file in self._files:
            if isinstance(file, np.memmap):
                file.flush()
