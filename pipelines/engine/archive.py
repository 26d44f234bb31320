"""Results of stages as they are kept: a folder with a manifest, or the archive of a finished run.

The archive, `stages.tar.xz`, holds the stages and the configuration of a run, and of a fit its summary. Files that are
made again in seconds are left out; the manifests keep their sha256. JSON and CSV files are read from where they are
(`store.read_bytes`); `opened` gives stages' folders with all their files.
"""

import hashlib
import io
import re
import shutil
import sys
import tarfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pipelines.engine.digests import digest
from pipelines.engine.store import (
    ARCHIVE,
    CONFIG,
    SUMMARY,
    archive_files,
    corrupt,
    exists,
    packed_files,
    read_bytes,
    read_json,
    replacing,
    write_files,
    write_json,
)
from pipelines.errors import PipelineError

MANIFEST = "manifest.json"
# What archives leave out though only its command makes it again: critics, which only a continued training needs,
# pictures, and large trees, of which it holds the part that the policy reaches.
NOT_ARCHIVED = frozenset({"train/critics.safetensors", "prune/tree.svg", "polish/tree.svg"})
LARGE_NOT_ARCHIVED = frozenset({"imitate/tree.npz"})
LARGE_BYTES = 200_000
MANIFEST_FIELDS = {"stage", "version", "key", "settings", "outputs", "output_digest", "seconds"}

# From a run's folder and an unpacked stage of it to what the stage's archive leaves out: names and contents.
Derive = Callable[[Path, Path], dict[str, bytes]]


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return a finished folder's manifest; one that is broken or lacks a field is an error that names it."""
    manifest: dict[str, Any] = read_json(folder / MANIFEST)
    missing = MANIFEST_FIELDS - manifest.keys() if isinstance(manifest, dict) else MANIFEST_FIELDS
    if missing:
        raise corrupt(folder / MANIFEST, ValueError(f"it has no {', '.join(sorted(missing))}"))
    return manifest


def verified_manifest(folder: Path) -> dict[str, Any]:
    """Return a finished stage's manifest after comparing every file that is kept of it with its recorded sha256."""
    manifest, packed = read_manifest(folder), packed_files(folder)
    for name, recorded in manifest["outputs"].items():
        if not (folder / name).is_file() and _needs_command(folder, name):
            continue
        if packed:
            # What is left out is compared when it is made again.
            found = bytes_digest(packed[name]) if name in packed else recorded
        else:
            found = file_digest(folder / name) if (folder / name).is_file() else "no file"
        if found != recorded:
            place = folder.parent / ARCHIVE if packed else folder
            raise PipelineError(
                f"{folder / name} is not what was written: its sha256 is {found[:12]}, the manifest has "
                f"{recorded[:12]}\nRestore it, or delete {place} and do the run again, which makes it."
            )
    return manifest


@contextmanager
def opened(run_dir: Path, stages: Collection[str], derive: Derive | None = None) -> Iterator[Path]:
    """Give a run's folder that holds these stages with all their files, as far as the run has them.

    It is the run's own where none of them is packed, else a temporary one.

    Args:
        run_dir: the run's folder.
        stages: names of stages.
        derive: makes again what the archive leaves out; without it that stays out.

    Raises:
        PipelineError: a packed file was changed, or what is made again is not what was recorded. Of arrays that is
            printed instead, as processors round them differently.
    """
    packed = {name: files for name in stages if (files := packed_files(run_dir / name))}
    if not packed:
        yield run_dir
        return
    with TemporaryDirectory(prefix="otr-") as place:
        whole = Path(place) / run_dir.name
        whole.mkdir()
        for path in run_dir.iterdir():
            if path.is_dir() and path.name in stages:
                shutil.copytree(path, whole / path.name)
            elif path.is_file() and path.name != ARCHIVE:
                shutil.copyfile(path, whole / path.name)
        for name in (CONFIG, SUMMARY):
            if not (whole / name).exists() and exists(run_dir / name):
                (whole / name).write_bytes(read_bytes(run_dir / name))
        for name, files in packed.items():
            (whole / name).mkdir()
            write_files(files, whole / name)
            verified_manifest(run_dir / name)
            if derive:
                _complete(run_dir, whole / name, derive)
        yield whole


def require_whole(folder: Path) -> None:
    """Raise a `PipelineError` that says how to get it where a stage's archive leaves out a large tree."""
    if not is_whole(folder):
        command = read_manifest(folder)["command"]
        raise PipelineError(
            f"{folder} is packed without its tree, which has more than {LARGE_BYTES // 1000} kB: {ARCHIVE} has the "
            f"pruned one, of stage prune\nThis makes it again, in another folder: {command} results_dir=DIR"
        )


def is_whole(folder: Path) -> bool:
    """Return whether a finished stage has its large files, too, in its folder or packed."""
    names = [name for name in read_manifest(folder)["outputs"] if f"{folder.name}/{name}" in LARGE_NOT_ARCHIVED]
    return all(exists(folder / name) for name in names)


def _complete(run_dir: Path, folder: Path, derive: Derive) -> None:
    """Add to an unpacked stage what its run's archive leaves out; nothing where that lacks the tree to make it from.

    Another processor rounds a tree's arrays differently, in their last bit. Arrays that differ are therefore taken,
    whatever the difference, as the recorded ones are not kept to compare with; it is printed, and the unpacked manifest
    has the digests of what was made here. Text that differs although its arrays are the same is refused.
    """
    if not is_whole(folder):
        return
    manifest = read_manifest(folder)
    outputs = manifest["outputs"]
    left_out = [name for name in outputs if not (folder / name).is_file() and not _needs_command(folder, name)]
    made = derive(run_dir, folder) if left_out else {}
    for name in left_out:
        if name not in made:
            raise _not_as_recorded(run_dir, folder.name, name, "cannot be made again", manifest)
        (folder / name).write_bytes(made[name])
    others = {name: found for name in left_out if (found := bytes_digest(made[name])) != outputs[name]}
    if not others:
        return
    if not any(name.endswith(".npz") for name in others):
        what = "comes out with another sha256 than was recorded"
        raise _not_as_recorded(run_dir, folder.name, next(iter(others)), what, manifest)
    print(
        f"{run_dir / folder.name}: {', '.join(others)}, made again from the recorded actor, have another sha256 than "
        f"at revision {manifest.get('git_revision')}: another processor or other packages round differently in the "
        "last bit; by how much these differ is not known",
        file=sys.stderr,
    )
    outputs |= others
    write_json(folder / MANIFEST, manifest | {"output_digest": digest(outputs)})


def _not_as_recorded(run_dir: Path, stage: str, name: str, what: str, manifest: Mapping[str, Any]) -> PipelineError:
    return PipelineError(
        f"{run_dir / stage / name} is left out of {ARCHIVE}, and {what}\n"
        f"It was made at revision {manifest.get('git_revision')} with {manifest.get('versions')}: use these, or delete "
        f"{run_dir} and do the run again, which makes it."
    )


def pack(
    run_dir: Path, derive: Derive | None = None, leave: Collection[str] = (), of_run: Collection[str] = (CONFIG,)
) -> None:
    """Put the finished stages and some files of a run into its archive, read that back, and remove the files.

    The same stages give the same archive. What is in the archive already stays there, unless the stage's folder
    exists, too. The configuration no longer names the folder of results, which was one of this machine.

    Args:
        run_dir: the run's folder.
        derive: makes again what is left out; only what it makes again byte for byte is.
        leave: stages whose folders stay.
        of_run: the files of the run itself that go into the archive, too.

    Raises:
        PipelineError: a file was changed since it was written.
    """
    there = {path.parent.name for path in run_dir.glob(f"[!.]*/{MANIFEST}")}.difference(leave)
    loose = {name: (run_dir / name).read_bytes() for name in of_run if (run_dir / name).is_file()}
    if not there and not (loose and archive_files(run_dir)):
        return
    if CONFIG in loose:
        loose[CONFIG] = re.sub(rb"(?m)^results_dir: .*$", b"results_dir: results", loose[CONFIG])
    packed = {name: content for name, content in archive_files(run_dir).items() if name.partition("/")[0] not in there}
    for stage in {name.partition("/")[0] for name in packed if "/" in name}:
        verified_manifest(run_dir / stage)
    kept = {stage: _kept(run_dir, run_dir / stage, derive) for stage in there}
    files = packed | {f"{stage}/{name}": content for stage in kept for name, content in kept[stage].items()} | loose
    with replacing(run_dir / ARCHIVE) as temporary:
        _write_archive(temporary, files)
    if archive_files(run_dir) != files:
        raise PipelineError(f"{run_dir / ARCHIVE} does not hold what was written to it; the folders stay")
    for name in loose:
        (run_dir / name).unlink()
    for name in there:
        gone = (run_dir / name).rename(run_dir / f".{name}.tmp")  # at once, so that half a folder is never visible
        shutil.rmtree(gone)


def _kept(run_dir: Path, folder: Path, derive: Derive | None) -> dict[str, bytes]:
    """Return the files of a stage that its run's archive has to hold."""
    outputs = verified_manifest(folder)["outputs"]
    made = derive(run_dir, folder) if derive else {}
    left_out = {name for name, content in made.items() if bytes_digest(content) == outputs.get(name)}
    left_out |= {name for name in outputs if _needs_command(folder, name, _n_bytes(folder / name))}
    return {name: (folder / name).read_bytes() for name in (MANIFEST, *outputs) if name not in left_out}


def _n_bytes(path: Path) -> int:
    """Return the size of a file; one that an archive left out before was large."""
    return path.stat().st_size if path.exists() else LARGE_BYTES + 1


def _needs_command(folder: Path, name: str, n_bytes: int = LARGE_BYTES + 1) -> bool:
    """Return whether an archive leaves out this file of a stage, of so many bytes, and nothing derives it."""
    member = f"{folder.name}/{name}"
    return member in NOT_ARCHIVED or (member in LARGE_NOT_ARCHIVED and n_bytes > LARGE_BYTES)


def _write_archive(path: Path, files: Mapping[str, bytes]) -> None:
    with tarfile.open(path, "w:xz", format=tarfile.USTAR_FORMAT, preset=6) as archive:
        for name in sorted(files):
            member = tarfile.TarInfo(name)  # dated 1970, without owner: the same files give the same bytes
            member.size = len(files[name])
            archive.addfile(member, io.BytesIO(files[name]))


def file_digest(path: Path) -> str:
    """Return the sha256 of a file's bytes, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def bytes_digest(content: bytes) -> str:
    """Return the sha256 of bytes, in hex."""
    return hashlib.sha256(content).hexdigest()
