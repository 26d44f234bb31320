"""A server that stands for GitHub, small files with known hashes, and the real files where they are at hand."""

import dataclasses
import hashlib
import http.server
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipelines.datasets import catalogue, load
from pipelines.datasets.catalogue import FILES, git_blob_hash
from pipelines.datasets.dataset import PARTS

ROOT = Path(__file__).parents[3]
# Found before a test can change it.
REAL_DATA = Path(os.environ.get("OTR_DATA_DIR") or ROOT.parent / "shared" / "data").absolute()


@pytest.fixture(autouse=True)
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give the test a data folder of its own, empty, and no OTR_DATA_DIR; return it."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "share"))
    monkeypatch.delenv("OTR_DATA_DIR", raising=False)
    return tmp_path / "share" / "otr"


@pytest.fixture
def real_data(monkeypatch: pytest.MonkeyPatch) -> Path:
    """Point OTR_DATA_DIR to the real files, or skip where they are not at hand."""
    if not (REAL_DATA / "lcn" / "HIV_split").is_dir():
        pytest.skip(f"{REAL_DATA} has no lcn/HIV_split; set OTR_DATA_DIR to a folder with the real files")
    monkeypatch.setenv("OTR_DATA_DIR", str(REAL_DATA))
    return REAL_DATA


class Server:
    """Answers requests from `answers`: bytes, a status code, or bytes and a length that is promised.

    `asked` has the paths in the order of the requests.
    """

    def __init__(self) -> None:
        self.answers: dict[str, bytes | int | tuple[bytes, int]] = {}
        self.asked: list[str] = []
        server = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                server.asked.append(self.path)
                answer = server.answers.get(self.path, 404)
                if isinstance(answer, int):
                    self.send_error(answer)
                    return
                content, n_bytes = answer if isinstance(answer, tuple) else (answer, len(answer))
                self.send_response(200)
                self.send_header("Content-Length", str(n_bytes))
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, *_: object) -> None:
                pass

        self._httpd = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.root = f"http://127.0.0.1:{self._httpd.server_port}"
        self._thread = threading.Thread(target=self._httpd.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._httpd.shutdown()
        self._httpd.server_close()
        self._thread.join()


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """Give a server that the addresses of all files lead to: /pinned and /master for LCN's."""
    server = Server()
    monkeypatch.setattr(catalogue, "LCN_ROOTS", (f"{server.root}/pinned", f"{server.root}/master"))
    yield server
    server.close()


def expect(monkeypatch: pytest.MonkeyPatch, path: str, content: bytes) -> None:
    """Make `content` what a file of the catalogue must hold."""
    changed = dataclasses.replace(
        FILES[path],
        n_bytes=len(content),
        git_blob=git_blob_hash(content),
        sha256=hashlib.sha256(content).hexdigest(),
    )
    monkeypatch.setitem(FILES, path, changed)


def split_file(names: str, *rows: tuple[int, str]) -> bytes:
    """Return a split file with these label names (as CSV); a row is the bit that is set, and its labels as CSV."""
    lines = [f"smiles,{names}"]
    lines += ["0" * bit + "1" + "0" * (2047 - bit) + "," + labels for bit, labels in rows]
    return ("\n".join(lines) + "\n").encode()


@pytest.fixture
def tiny_bace(monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """Make Bace three tiny files, and return their content by path."""
    contents = {
        f"lcn/bace_split/{part}.fgp2048.csv": split_file("Class", (i, "1"), (i + 10, "0"))
        for i, part in enumerate(PARTS)
    }
    for path, content in contents.items():
        expect(monkeypatch, path, content)
    monkeypatch.setattr(load, "scaffolds_by_part", lambda entry: dict.fromkeys(PARTS, np.arange(2)))
    return contents
