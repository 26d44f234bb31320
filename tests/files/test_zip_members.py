import io
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import otr
from otr.files.zip_members import read_members

MEGABYTE = 2**20


def packed(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def read(content: bytes, *names: str, limit_bytes: int = MEGABYTE) -> dict[str, bytes]:
    return dict(read_members(io.BytesIO(content), "it", names or None, limit_bytes=limit_bytes))


def patched(content: bytes, signature: bytes, offset: int, value: bytes) -> bytes:
    at = content.index(signature) + offset
    return content[:at] + value + content[at + len(value) :]


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_members_are_read_as_they_were_written(tmp_path: Path, method: int) -> None:
    members = {"a": b"x" * 5000, "b/c": b"", "d": bytes(range(256)) * 40}
    (tmp_path / "file.zip").write_bytes(packed(members, method))
    assert dict(read_members(tmp_path / "file.zip", "file.zip")) == members
    assert list(read(packed(members, method), "d", "a")) == ["a", "d"]
    with pytest.raises(FileNotFoundError):
        dict(read_members(tmp_path / "none", "none"))
    with pytest.raises(otr.ArtefactError, match="cannot be read"):
        dict(read_members(tmp_path, "the folder"))


def test_what_unpacks_to_more_than_the_limit_is_refused() -> None:
    assert len(read(packed({"a": bytes(MEGABYTE)}))["a"]) == MEGABYTE
    for members in ({"a": bytes(MEGABYTE + 1)}, {"a": bytes(MEGABYTE), "b": b"x"}):
        with pytest.raises(otr.ArtefactError, match=r"it unpacks to 1,048,577 bytes, the limit is 1,048,576; nothing"):
            read(packed(members))
    large = {"a": bytes(2 * MEGABYTE), "b": b"x"}
    assert read(packed(large), "b") == {"b": b"x"}, "only what is wanted counts"
    assert read(packed(large, zipfile.ZIP_STORED)) == large, "what is stored as it is may be of any size"


def test_members_that_share_their_bytes_are_refused() -> None:
    content = packed({"a": bytes(MEGABYTE), "b": b""}, zipfile.ZIP_STORED)
    directory = content.index(b"PK\1\2")
    entry = content[directory : directory + 46] + b"b"  # the first entry again, under the second's name
    end = content.index(b"PK\5\6")
    second = content.index(b"PK\1\2", directory + 4)
    shared = content[:second] + entry + content[end:]
    with pytest.raises(otr.ArtefactError, match="unpacks to 2,097,152"):
        read(shared)


@pytest.mark.skipif(sys.platform != "linux", reason="limits its own memory by what /proc says")
def test_a_header_that_lies_unpacks_no_more_than_it_says() -> None:
    """The stream holds 1 GiB, the header says 5 bytes; a process that may use 512 MiB more than before reads it."""
    code = """
import io, resource, struct, sys, zipfile, zlib
from otr.errors import ArtefactError
from otr.files.zip_members import read_members
packer = zlib.compressobj(9, zlib.DEFLATED, -15)
block = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)  # stands on its own
stream = 2**10 * block + packer.flush()
file = io.BytesIO()
with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
    archive.writestr(zipfile.ZipInfo("a", (2026, 11, 30, 12, 12, 0)), b"12345", zipfile.ZIP_DEFLATED)
content = file.getvalue()
start = 30 + len("a")  # of what is packed: after a header of 30 bytes, which may hold any byte, and the name
directory = content.index(b"PK\\1\\2")
crc = zlib.crc32(bytes(5)) if sys.argv[1] == "right" else 1
sizes = struct.pack("<III", crc, len(stream), 5)
end = content.index(b"PK\\5\\6")
entry = content[directory : directory + 16] + sizes + content[directory + 28 : end]
tail = content[end : end + 12] + struct.pack("<II", len(entry), start + len(stream)) + content[end + 20 :]
crafted = content[:14] + sizes + content[26:start] + stream + entry + tail
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**29, used + 2**29))
try:
    print(dict(read_members(io.BytesIO(crafted), "it")))
except ArtefactError as error:
    print(error)
"""
    for crc, message in (("right", "{'a': b'\\x00\\x00\\x00\\x00\\x00'}"), ("wrong", "it cannot be read (Bad CRC-32")):
        out = subprocess.run([sys.executable, "-c", code, crc], check=True, capture_output=True, text=True)
        assert out.stdout.startswith(message)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_files_that_are_refused() -> None:
    twice = io.BytesIO()
    with zipfile.ZipFile(twice, "w") as archive:
        for content in (b"1", b"2"):
            archive.writestr("a", content)
    good = packed({"a": b"content" * 100})
    refused = [
        (twice.getvalue(), r"it holds 2 members named 'a', expected one"),
        (patched(good, b"PK\1\2", 8, struct.pack("<H", 1)), r"'a' in it is encrypted"),
        (packed({"a": b"1" * 1000}, zipfile.ZIP_LZMA), r"'a' in it is packed by method 14, expected 0 \(stored\) or 8"),
        (packed({"a": b"1" * 1000}, zipfile.ZIP_BZIP2), r"'a' in it is packed by method 12"),
        (patched(good, b"PK\1\2", 24, struct.pack("<I", 800)), r"'a' in it holds 700 bytes, its header says 800|CRC"),
        (patched(good, b"PK\1\2", 42, struct.pack("<I", 2**31)), r"it cannot be read \("),
        (good[:-30], r"it cannot be read \(File is not a zip file\); it is cut off"),
        (b"", r"it cannot be read \(File is not a zip file\); is it the right file\?"),
        (b"a text", r"it cannot be read \(File is not a zip file\); is it the right file\?"),
    ]
    for content, message in refused:
        with pytest.raises(otr.ArtefactError, match=message):
            read(content)
    with pytest.raises(otr.ArtefactError, match=r"it holds no 'b', only \['a'\]"):
        read(good, "b")
