"""Reading and writing artefacts: text, JSON and CSV files that appear whole or not at all. No pickle anywhere.

What belongs in the folder of a run's stage, `<run>/<stage>/<file>`, may be in the run's archive instead, in
`<run>/stages.tar.xz` as `<stage>/<file>`, and is read from there; so may `<run>/config.yaml` and `<run>/summary.json`.
"""

import csv
import functools
import io
import json
import os
import shutil
import tarfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from lzma import LZMADecompressor, LZMAError
from pathlib import Path
from typing import Any

from pipelines.errors import PipelineError

ARCHIVE = "stages.tar.xz"
CONFIG, SUMMARY = "config.yaml", "summary.json"
LARGEST_ARCHIVE_BYTES = 2**28  # unpacked
REWRITTEN = (SUMMARY, CONFIG)  # made again by the run's command, from the finished stages


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a file to write in place of `path`: a reader sees the old one or the new one, never a part."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def unfinished(folder: Path) -> Iterator[Path]:
    """Give an empty folder next to `folder` to write into and to rename; what remains afterwards is removed."""
    temporary = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write text, atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write JSON-able data, indented and with its keys in the order given, atomically."""
    write_text(path, json_text(value))


def json_text(value: Any) -> str:
    """Return JSON-able data as the text of a file."""
    return json.dumps(value, indent=2, allow_nan=False) + "\n"


def read_json(path: Path) -> Any:
    """Return what a JSON file holds; a missing or broken file is an error that names it."""
    try:
        return json.loads(read_bytes(path).decode())
    except (OSError, ValueError) as error:
        raise corrupt(path, error) from error


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]], columns: Iterable[str]) -> None:
    """Write rows under the named columns, atomically; floats keep every digit (shortest exact form)."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_summary(run_dir: Path) -> dict[str, Any]:
    """Return the summary of a run or fit, empty where it has none yet; raises as `read_json` does."""
    path = run_dir / SUMMARY
    return dict(read_json(path)) if exists(path) else {}


def read_csv(path: Path) -> list[dict[str, str]]:
    """Return a CSV file's rows as text; a missing file is an error that names it."""
    try:
        return list(csv.DictReader(io.StringIO(read_bytes(path).decode(), newline="")))
    except (OSError, csv.Error, UnicodeDecodeError) as error:
        raise corrupt(path, error) from error


def write_files(files: Mapping[str, bytes], folder: Path) -> None:
    """Write files of these names and contents."""
    for name, content in files.items():
        (folder / name).write_bytes(content)


def exists(path: Path) -> bool:
    """Return whether there is a stage's file, a run's configuration or its summary, in its folder or packed."""
    return path.is_file() or bool(packed_files(path.parent, path.name)) or path.name in archive_files(path.parent)


def read_bytes(path: Path) -> bytes:
    """Return the content of a stage's file, a run's configuration or its summary, from its folder or packed.

    Raises:
        FileNotFoundError: it is in neither.
        PipelineError: the archive is damaged.
    """
    packed: Mapping[str, bytes] = packed_files(path.parent, path.name)
    if not packed and not path.exists():
        packed = archive_files(path.parent)
    return packed[path.name] if path.name in packed else path.read_bytes()


def packed_files(folder: Path, name: str | None = None) -> dict[str, bytes]:
    """Return the files of a stage, or the one named, from its run's archive; none where the stage's folder exists."""
    if folder.exists():
        return {}
    start = f"{folder.name}/"
    stage = {
        each.removeprefix(start): content
        for each, content in archive_files(folder.parent).items()
        if each.startswith(start)
    }
    return {each: content for each, content in stage.items() if name in (None, each)}


def archive_files(run_dir: Path) -> Mapping[str, bytes]:
    """Return the files of a run's archive, `<stage>/<file>` and those of the run; none where there is no archive."""
    archive = run_dir / ARCHIVE
    if not archive.is_file():
        return {}
    found = archive.stat()
    return _read_archive(archive, found.st_mtime_ns, found.st_size)


@functools.lru_cache(maxsize=4)  # the next request is mostly of the same run
def _read_archive(archive: Path, mtime_ns: int, n_bytes: int) -> Mapping[str, bytes]:
    """Return the files of an archive; its time and size distinguish it from an earlier one."""
    files = {}
    try:
        unpacking = LZMADecompressor()
        content = unpacking.decompress(archive.read_bytes(), max_length=LARGEST_ARCHIVE_BYTES)
        if not unpacking.eof:
            raise ValueError(f"it is cut off, or unpacks to more than {LARGEST_ARCHIVE_BYTES:,} bytes")
        with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as packed:
            for member in packed:
                file = packed.extractfile(member)
                if file is None:
                    raise ValueError(f"{member.name!r} is no file of a stage")
                files[member.name] = file.read()
    except (OSError, ValueError, LZMAError, tarfile.TarError) as error:
        raise corrupt(archive, error) from error
    return files


def corrupt(path: Path, error: Exception) -> PipelineError:
    """Return the error for an artefact that cannot be read, with the remedy."""
    if path.name in REWRITTEN:
        remedy = f"Delete {path} and run the run's command again to make it; nothing is trained again."
    else:
        remedy = f"Restore it, or delete the folder {path.parent} and do the run again, which makes it."
    what = "is not there" if isinstance(error, FileNotFoundError) else f"cannot be read: {error}"
    return PipelineError(f"{path} {what}\n{remedy}")
