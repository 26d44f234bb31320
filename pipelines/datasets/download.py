"""Files of data sets: found in a local folder, or fetched once, compared with their hashes and kept.

A data folder holds `lcn/bace_split/train.fgp2048.csv` and so on, each plain or packed with `.gz` after its name. The
user's own is `$XDG_DATA_HOME/otr` or `~/.local/share/otr`. `OTR_DATA_DIR` names another one, which is only read: it
comes first, and nothing is fetched while it is set. It may also be the folder `data` of a clone of LCN's repository.
"""

import gzip
import http.client
import io
import os
import sys
import urllib.error
import urllib.request
import zlib
from pathlib import Path

from pipelines.datasets.catalogue import DataFile
from pipelines.engine.store import replacing
from pipelines.errors import ConfigError, MissingInputError, PipelineError

TIMEOUT_S = 30.0  # without a byte from the server
LARGEST_BYTES = 2**31  # of a file whose size is not known
BROKEN_GZIP = (EOFError, gzip.BadGzipFile, zlib.error)


def own_folder() -> Path:
    """Return the user's data folder, which need not exist yet."""
    base = Path(os.environ.get("XDG_DATA_HOME", ""))
    return (base if base.is_absolute() else Path.home() / ".local" / "share") / "otr"


def given_folder() -> Path | None:
    """Return the folder that OTR_DATA_DIR names, if it is set."""
    value = os.environ.get("OTR_DATA_DIR")
    if not value:
        return None
    folder = Path(value).expanduser().absolute()
    if not folder.is_dir():
        raise ConfigError(f"OTR_DATA_DIR={value}: there is no such folder; name one with data files, or unset it")
    return folder


def locate(file: DataFile) -> Path | None:
    """Return where the file is on this machine, plain or packed; None where it is not."""
    given = given_folder()
    places = [given / file.path, given / file.path.removeprefix("lcn/")] if given else []
    for place in (*places, own_folder() / file.path):
        for path in (place, Path(f"{place}.gz")):
            if path.is_file():
                return path
    return None


def read(file: DataFile) -> bytes:
    """Return a file's content: that of the local copy, or else of the one that is fetched now and kept.

    Raises:
        MissingInputError: it is not here and could not be fetched; names the addresses, the hash and where to put it.
        PipelineError: the local copy is damaged or another file.
    """
    path = locate(file)
    if path is not None:
        return _read_local(file, path)
    given = given_folder()
    if given is not None:
        raise MissingInputError(
            f"{file.path} is neither in OTR_DATA_DIR={given} nor in {own_folder()}\n"
            f"Unset OTR_DATA_DIR to have it fetched, or fetch it yourself from {' or '.join(file.addresses)} "
            f"({file.hashes}) and put it at {given / file.path}"
        )
    content = _fetch(file)
    keep(file, content)
    return content


def keep(file: DataFile, content: bytes) -> Path:
    """Write a file into the user's own folder, packed unless it is packed already; a partial file is never visible."""
    packed = file.path.endswith(".gz")
    path = own_folder() / (file.path if packed else f"{file.path}.gz")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_bytes(content if packed else gzip.compress(content, compresslevel=6, mtime=0))
    except OSError as error:
        raise PipelineError(
            f"cannot write {path}: {error.strerror or error}\nMake room there, or set XDG_DATA_HOME to another folder."
        ) from error
    return path


def gunzip(packed: bytes, limit: int) -> bytes:
    """Return what a gzip file holds; one that is broken, or unpacks to more than `limit` bytes, is an error."""
    with gzip.GzipFile(fileobj=io.BytesIO(packed)) as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise gzip.BadGzipFile(f"it unpacks to more than {limit:,} bytes")
    return content


def _read_local(file: DataFile, path: Path) -> bytes:
    try:
        content = path.read_bytes()
        if path.suffix == ".gz" and not file.path.endswith(".gz"):
            content = gunzip(content, file.n_bytes or LARGEST_BYTES)
        difference = file.difference(content)
    except (OSError, *BROKEN_GZIP) as error:
        difference = str(error)
    if difference:
        raise PipelineError(
            f"{path} is not the file that it should be: {difference}\n"
            f"Delete it, or put the one from {' or '.join(file.addresses)} there ({file.hashes})."
        )
    return content


def _fetch(file: DataFile) -> bytes:
    """Return the content from the first address that gives the right one."""
    failures = []
    for address in file.addresses:
        try:
            content = _receive(address, file.n_bytes or LARGEST_BYTES)
            difference = file.difference(content)
        except urllib.error.HTTPError as error:
            failures.append(f"{address}: {error.code} {error.reason}")
            continue
        except (OSError, http.client.HTTPException) as error:
            failures.append(f"{address}: {getattr(error, 'reason', None) or error or type(error).__name__}")
            if isinstance(error, urllib.error.URLError):
                break  # no way to that server: the other address is on it, too
            continue
        if not difference:
            return content
        failures.append(f"{address}: another file came, {difference}")
    raise MissingInputError(
        "cannot fetch "
        + "\n  or ".join(failures)
        + f"\nTry again later, or fetch the file by other means ({file.hashes}) and put it at "
        f"{own_folder() / file.path}, or at FOLDER/{file.path} with OTR_DATA_DIR=FOLDER"
    )


def _receive(address: str, limit: int) -> bytes:
    """Return what an address sends, at most `limit` bytes; a connection that ends early is an error."""
    request = urllib.request.Request(address, headers={"User-Agent": "otr-data"})
    with urllib.request.urlopen(request, timeout=TIMEOUT_S) as response:
        due = response.length or 0
        print(f"fetching {address}" + (f", {due / 1e6:.3g} MB" if due else ""), file=sys.stderr, flush=True)
        content: bytes = response.read(limit + 1)
    if len(content) > limit:
        raise OSError(f"more than the {limit:,} bytes that it may have")
    if len(content) < due:
        raise OSError(f"the connection ended after {len(content):,} of {due:,} bytes")
    return content
