"""Members of a zip file, read so that a small file never becomes a large one in memory."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO

from otr.errors import ArtefactError

LIMIT_BYTES = 2**28
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # the others unpack a chunk without a limit
_BROKEN = (OSError, ValueError, EOFError, RuntimeError, OverflowError, struct.error, zlib.error)


def read_members(
    file: Path | IO[bytes], label: str, names: Collection[str] | None = None, *, limit_bytes: int = LIMIT_BYTES
) -> Iterator[tuple[str, bytes]]:
    """Yield (name, content) of the members of a zip file, in the file's order; check all of them before the first.

    Together they may unpack to `limit_bytes`, or to the size of the file itself where that is more: members that are
    stored as they are (numpy.savez, torch.save) may be of any size, small files that unpack to large ones are refused.
    What is read never exceeds what a member declares, whatever its stream unpacks to.

    `file` is a path, or an open file that can seek; `label` is its name in messages; `names` are the members wanted,
    None for all. Raise FileNotFoundError, or ArtefactError for a file that is too large, encrypted, packed by another
    method than deflate, cut off, changed or no zip file, and for a member that is missing or there twice.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            members = _checked(archive, label, names, limit_bytes)
            for member in members:
                yield member.filename, _read(archive, member, label)
    except FileNotFoundError:
        raise
    except zipfile.BadZipFile as error:
        what = "it is cut off or changed: write it again" if _starts_as_zip(file) else "is it the right file?"
        raise ArtefactError(f"{label} cannot be read ({error}); {what}") from error
    except _BROKEN as error:
        raise ArtefactError(f"{label} cannot be read ({error}); it is cut off or changed: write it again") from error


def _checked(
    archive: zipfile.ZipFile, label: str, names: Collection[str] | None, limit_bytes: int
) -> list[zipfile.ZipInfo]:
    """Return the members wanted, or raise ArtefactError; nothing is unpacked."""
    counts = Counter(archive.namelist())
    twice = [name for name, count in counts.items() if count > 1]
    if twice:
        raise ArtefactError(
            f"{label} holds {counts[twice[0]]} members named {twice[0]!r}, expected one; write it again"
        )
    missing = [name for name in names or () if name not in counts]
    if missing:
        raise ArtefactError(f"{label} holds no {missing[0]!r}, only {sorted(counts)[:5]}; is it the right file?")
    members = [member for member in archive.infolist() if names is None or member.filename in names]
    for member in members:
        if member.flag_bits & 0x1:
            raise ArtefactError(f"{member.filename!r} in {label} is encrypted; write the file without a password")
        if member.compress_type not in _METHODS:
            raise ArtefactError(
                f"{member.filename!r} in {label} is packed by method {member.compress_type}, expected 0 (stored) or "
                "8 (deflate); write the file again"
            )
    n_bytes = sum(member.file_size for member in members)
    limit_bytes = max(limit_bytes, _size(archive))
    if n_bytes > limit_bytes:
        raise ArtefactError(
            f"{label} unpacks to {n_bytes:,} bytes, the limit is {limit_bytes:,}; nothing was unpacked: if the file is "
            "yours, write it again without compression"
        )
    return members


def _starts_as_zip(file: Path | IO[bytes]) -> bool:
    if isinstance(file, Path):
        with file.open("rb") as opened:
            return opened.read(2) == b"PK"
    file.seek(0)
    return file.read(2) == b"PK"


def _size(archive: zipfile.ZipFile) -> int:
    """Return the size of the file in bytes."""
    assert archive.fp is not None
    return archive.fp.seek(0, 2)


def _read(archive: zipfile.ZipFile, member: zipfile.ZipInfo, label: str) -> bytes:
    """Return a member's content."""
    with archive.open(member) as stream:
        # Without the number, up to 2 GB of the stream are unpacked before what the header declares is cut out of it.
        content = stream.read(member.file_size)
    if len(content) != member.file_size:
        raise ArtefactError(
            f"{member.filename!r} in {label} holds {len(content):,} bytes, its header says {member.file_size:,}; "
            "the file is cut off or changed: write it again"
        )
    return content
