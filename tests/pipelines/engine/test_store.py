"""A file that does not fit on the disk leaves nothing of itself, and what was there before stays."""

import errno
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import otr
from pipelines.engine.archive import MANIFEST, pack
from pipelines.engine.store import write_csv, write_json, write_text
from pipelines.training.checkpoints import History, write_segment


@contextmanager
def full_disk() -> Iterator[None]:
    """Let no file grow beyond 64 bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def _pack(folder: Path) -> None:
    stage = folder / "map"
    if not stage.is_dir():
        stage.mkdir()
        write_json(stage / MANIFEST, {
            "stage": "map", "version": 1, "key": "k", "settings": {}, "outputs": {}, "output_digest": "", "seconds": 1,
        })  # fmt: skip
        return
    pack(folder)


WRITERS: dict[str, Callable[[Path], None]] = {
    "text": lambda folder: write_text(folder / "a.txt", "x" * 100),
    "csv": lambda folder: write_csv(folder / "a.csv", [{"a": "x" * 100}], ["a"]),
    "tree": lambda folder: otr.save(otr.ObliqueTree([], [], np.zeros((0, 1)), [], [[[1.0]]], [[0.0]]), folder / "tree"),
    "segment": lambda folder: write_segment(folder, History(), {}, {"actor": b"x" * 100}),
    "archive": _pack,
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_nothing_is_left_of_what_does_not_fit(write: Callable[[Path], None], tmp_path: Path) -> None:
    write(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with full_disk(), pytest.raises(OSError) as caught:
        write(tmp_path)
    assert caught.value.errno == errno.EFBIG
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
