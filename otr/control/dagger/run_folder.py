"""What a DAgger run leaves in its folder: aggregated data, trees, and the state that says how much of them counts."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import IO, Any

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.black_box import BlackBox
from otr.core.network import ReluNetwork
from otr.core.pattern_tree import PatternTree
from otr.core.smooth_network import Oracle
from otr.core.tree import ObliqueTree
from otr.errors import ArtefactError
from otr.files.artefacts import load, save, write_atomically

SCHEMA = "otr/dagger/1"


class RunFolder:
    """A run's folder: its `state` is dagger.json, which is replaced as a whole after the other files are written."""

    def __init__(self, folder: Path, oracle: Oracle, seed: np.random.SeedSequence, settings: dict[str, Any]) -> None:
        """Make the folder, or resume its run; raise ArtefactError if that is another run or cannot be read."""
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._states = GrowingArray(folder / "states.f64", oracle.n_inputs)
        self._answers = GrowingArray(folder / "answers.f64", oracle.n_outputs)
        self._weights = GrowingArray(folder / "weights.f64", 1)
        self._state_path = folder / "dagger.json"
        asked = {
            "schema": SCHEMA,
            "oracle": _digest(oracle),
            "seed": [str(seed.entropy), [int(key) for key in seed.spawn_key]],
            "settings": settings,
        }
        nothing = {"n_rows": 0, "n_steps": 0, "rollouts": [], "trees": [], "selection": {}}
        self.state: dict[str, Any] = self._read(asked) if self._state_path.exists() else {**asked, **nothing}

    def commit(self, **changes: Any) -> None:
        """Replace dagger.json by one with the changes, atomically."""
        state = {**self.state, **changes}

        def write(file: IO[bytes]) -> None:
            file.write(json.dumps(state, allow_nan=False).encode())
            file.flush()
            os.fsync(file.fileno())

        write_atomically(self._state_path, write)
        self.state = state

    def append(self, states: FloatArray, answers: FloatArray, weights: FloatArray | None) -> int:
        """Append labelled states to the committed rows, and return the new number of rows."""
        n_rows: int = self.state["n_rows"]
        self._answers.append(n_rows, answers)
        if weights is not None:
            self._weights.append(n_rows, weights[:, None])
        return self._states.append(n_rows, states)

    def data(self, n_rows: int, *, has_weights: bool) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Return the first `n_rows` states, answers and, where there are any, weights, memory-mapped."""
        weights = self._weights.view(n_rows)[:, 0] if has_weights else None
        return self._states.view(n_rows), self._answers.view(n_rows), weights

    def save_tree(self, r: int, tree: ObliqueTree | PatternTree) -> None:
        """Keep round r's tree."""
        save(tree, self._tree_path(r))

    def tree(self, r: int) -> ObliqueTree | PatternTree:
        """Return round r's tree."""
        tree = load(self._tree_path(r))
        assert isinstance(tree, ObliqueTree | PatternTree)
        return tree

    def _tree_path(self, r: int) -> Path:
        return self._folder / f"iterate-{r:03d}.json"

    def _read(self, asked: dict[str, Any]) -> dict[str, Any]:
        try:
            state: dict[str, Any] = json.loads(self._state_path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ArtefactError(
                f"{self._state_path} cannot be read: {error}; delete the folder to begin again"
            ) from error
        for name, value in asked.items():
            if state.get(name) != value:
                raise ArtefactError(
                    f"{self._state_path} belongs to another run: its {name} is {state.get(name)}, {value} was asked "
                    "for; take another folder, or delete this one"
                )
        return state


class GrowingArray:
    """A float64 array (n, width) in a raw file; rows are appended to those that the caller has committed.

    The caller knows how many rows count; a killed append leaves rows that the next one overwrites.
    """

    def __init__(self, path: Path, width: int) -> None:
        self._path = path
        self._row_bytes = 8 * width
        self._width = width

    def append(self, n_rows: int, rows: FloatArray) -> int:
        """Put `rows` (m, width) after the first `n_rows`, on the disk itself; return the new number of rows."""
        if rows.ndim != 2 or rows.shape[1] != self._width:
            raise ValueError(f"rows have shape {rows.shape}, expected (m, {self._width})")
        self._check(n_rows)
        with self._path.open("r+b" if self._path.exists() else "xb") as file:
            file.truncate(n_rows * self._row_bytes)
            file.seek(0, os.SEEK_END)
            file.write(np.ascontiguousarray(rows, dtype="<f8").tobytes())
            file.flush()
            os.fsync(file.fileno())
        return n_rows + len(rows)

    def view(self, n_rows: int) -> FloatArray:
        """Return the first `n_rows` rows, memory-mapped and read-only."""
        self._check(n_rows)
        return np.memmap(self._path, dtype="<f8", mode="r", shape=(n_rows, self._width))

    def _check(self, n_rows: int) -> None:
        size = self._path.stat().st_size if self._path.exists() else 0
        if size < n_rows * self._row_bytes:
            raise ArtefactError(
                f"{self._path} holds {size // self._row_bytes} rows, {n_rows} were committed; "
                f"delete {self._path.parent} to begin again"
            )


def _digest(oracle: Oracle) -> str:
    if isinstance(oracle, BlackBox):
        return oracle.digest
    units = f"{oracle.negative_slope} {oracle.dense}" if isinstance(oracle, ReluNetwork) else oracle.activation
    digest = hashlib.sha256(f"{units} {oracle.head!r}".encode())
    for array in (*oracle.weights, *oracle.biases):
        digest.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
