"""Stages: pure functions of inputs and settings whose results are kept, found again and never half written.

A stage is keyed by the sha256 of its name, its version, its settings and its inputs' digests. `run_stage` skips what is
done, waits where another process is making it, writes into a temporary folder, writes `manifest.json` last and renames.
"""

import operator
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock, Timeout

from pipelines.engine import provenance
from pipelines.engine.archive import (
    MANIFEST,
    Derive,
    file_digest,
    is_whole,
    opened,
    read_manifest,
    require_whole,
    verified_manifest,
)
from pipelines.engine.digests import digest, setting_differences
from pipelines.engine.store import exists, unfinished, write_json
from pipelines.errors import MissingInputError, OtherSettingsError, PipelineError

Part = TypeVar("Part")
Inputs = Mapping[str, Path]  # the folders of the stages that a stage reads, by name


@dataclass(frozen=True)
class Stage:
    """One step of a method. It is given its settings, never the job's whole configuration."""

    name: str  # its folder's name
    # Raised when the same inputs and settings would give something else; of a function, for these settings alone
    version: int | Callable[[Any], int]
    inputs: tuple[str, ...]  # the stages whose folders it reads
    keyed: Callable[[Any], dict[str, Any]]  # picks, from its settings, what decides the result; JSON-able
    # `(inputs, settings, out)` writes the result's files into the empty folder `out`
    run: Callable[[Inputs, Any, Path], None]
    # A dataclass, of which each field is the job's configuration's of that name; None for the configuration itself
    settings: type | None = None
    # Prints, for the settings of runs that are made together, how long that takes; raises where it is impossible
    announce: Callable[[Sequence[Any]], None] | None = None
    seconds_left: Callable[[Any], float] | None = None  # the likely time of what is not done yet, on one core
    # The files that it needs of the result that another job makes for this one, though archives leave them out
    needs: Callable[[Any], Collection[str]] | None = None
    # `run` for several jobs at once: returns what each failed with, or None
    together: Callable[[Sequence[Inputs], Sequence[Any], Sequence[Path]], Sequence[Exception | None]] | None = None
    is_of_other_job: bool = False  # it refers to what another job makes, which is done before
    is_transient: bool = False  # its result is large and only serves later stages; it may be deleted after these
    # From `(settings, inputs)` to the folder in which it keeps what it has done so far; that folder is removed once
    # the result is in its place
    checkpoints: Callable[[Any, Inputs], Path] | None = None

    def of(self, config: Any) -> Any:
        """Return the stage's settings in a job's configuration."""
        return config if self.settings is None else part_of(config, self.settings)

    def version_of(self, config: Any) -> int:
        """Return the version for a configuration."""
        return self.version if isinstance(self.version, int) else self.version(self.of(config))


def part_of(config: Any, kind: type[Part]) -> Part:
    """Return a dataclass of what a configuration has under the names of its fields."""
    assert is_dataclass(kind)
    part: Part = kind(**{field.name: getattr(config, field.name) for field in fields(kind)})
    return part


def picked(**paths: str) -> Callable[[Any], dict[str, Any]]:
    """Return a stage's `keyed`: under each name what is at its dotted path in the settings.

    A part of them is picked with all that it holds, or with what its own function `settings` returns.
    """

    def keyed(settings: Any) -> dict[str, Any]:
        found = {name: operator.attrgetter(path)(settings) for name, path in paths.items()}
        return {name: _plain(value) for name, value in found.items()}

    return keyed


def _plain(value: Any) -> Any:
    if not is_dataclass(value) or isinstance(value, type):
        return value
    return value.settings() if hasattr(value, "settings") else asdict(value)


@dataclass(frozen=True)
class StageResult:
    """Where a stage's files are, whether they existed before, and the seconds that making them took."""

    folder: Path
    skipped: bool
    seconds: float


def run_stage(
    stage: Stage,
    run_dir: Path,
    config: Any,
    rerun_command: str,
    derive: Derive | None = None,
    needed: Collection[str] = (),
) -> StageResult:
    """Bring a stage's result up to date; `rerun_command` does all stages, `derive` makes what archives leave out.

    A result that is kept without one of the `needed` files is made again, in its place.

    Raises:
        MissingInputError: an input stage has not been done; names the command that does it.
        OtherSettingsError: the folder holds the result of other settings.
        PipelineError: an input or the finished folder was damaged.
    """
    inputs = {name: _input_folder(run_dir, name, stage, rerun_command) for name in stage.inputs}
    result = _found_or_made(stage, run_dir, config, inputs, derive, needed)
    if stage.checkpoints:  # only now that the result is in its place
        shutil.rmtree(stage.checkpoints(stage.of(config), inputs), ignore_errors=True)
    return result


def _found_or_made(
    stage: Stage, run_dir: Path, config: Any, inputs: Inputs, derive: Derive | None, needed: Collection[str]
) -> StageResult:
    """Return a stage's result: the one in its folder, a sibling run's, or a new one."""
    wanted = stage_key(stage, config, inputs)
    folder = run_dir / stage.name
    with _lock(run_dir / f".{stage.name}.lock", f"{run_dir}: another process is at stage {stage.name}"):
        status = stage_status(stage, folder, config, wanted)
        if status == "other settings":
            raise _other_settings(stage, folder, config)
        if status == "done" and has_files(folder, needed):
            manifest = verified_manifest(folder)
            return StageResult(folder, skipped=True, seconds=manifest["seconds"])
        # Runs that differ in later stages alone share this result: one of them makes it, the others take it over.
        with _lock(_result_lock(config, stage, wanted), f"another run is making the {stage.name} of {run_dir}"):
            twin = _twin(run_dir, stage.name, wanted)
            if twin is not None and has_files(twin, needed):
                _copy_twin(twin, folder, derive)
                return StageResult(folder, skipped=True, seconds=read_manifest(folder)["seconds"])
            for name in stage.inputs:
                require_whole(run_dir / name)
            with opened(run_dir, stage.inputs, derive) as whole, unfinished(folder) as temporary:
                origin, start = _origin(), time.monotonic()
                stage.run({name: whole / name for name in stage.inputs}, stage.of(config), temporary)
                seconds = round(time.monotonic() - start, 3)
                _finish(stage, folder, temporary, config, wanted, seconds, origin)
    return StageResult(folder, skipped=False, seconds=seconds)


def run_stage_together(stage: Stage, requests: Sequence[tuple[Path, Any]]) -> list[Exception | None]:
    """Make the results of a stage for several runs at once (`Stage.together`), where nothing prevents it.

    `run_stage` handles runs that have theirs, that another process is making, or whose result another run holds. A
    failure of one run does not affect the others.

    Args:
        stage: the stage; what it reads is done in every run folder.
        requests: run folder and configuration of each run.

    Returns:
        What each request failed with, or None.
    """
    errors: list[Exception | None] = [None] * len(requests)
    with ExitStack() as stack:
        chosen: list[tuple[int, Path, str]] = []
        inputs = [{name: run_dir / name for name in stage.inputs} for run_dir, _ in requests]
        for i, (run_dir, config) in enumerate(requests):
            folder, wanted = run_dir / stage.name, stage_key(stage, config, inputs[i])
            lock = stack.enter_context(_lock(run_dir / f".{stage.name}.lock"))
            if not lock or stage_status(stage, folder, config, wanted) in ("done", "other settings"):
                continue
            is_first = stack.enter_context(_lock(_result_lock(config, stage, wanted)))
            if is_first and _twin(run_dir, stage.name, wanted) is None:
                chosen.append((i, folder, wanted))
        if not chosen:
            return errors
        origin, start = _origin(), time.monotonic()
        folders = [stack.enter_context(unfinished(folder)) for _, folder, _ in chosen]
        assert stage.together is not None
        settings = [stage.of(requests[i][1]) for i, _, _ in chosen]
        failures = stage.together([inputs[i] for i, _, _ in chosen], settings, folders)
        share = round((time.monotonic() - start) / len(chosen), 3)
        for (i, folder, wanted), temporary, failure in zip(chosen, folders, failures, strict=True):
            errors[i] = failure
            if failure is None:
                _finish(stage, folder, temporary, requests[i][1], wanted, share, origin)
    return errors


def stage_key(stage: Stage, config: Any, inputs: Inputs) -> str:
    """Return the key of a stage's result: of its version, its settings and its inputs."""
    digests = {name: verified_manifest(folder)["output_digest"] for name, folder in inputs.items()}
    keyed = stage.keyed(stage.of(config))
    return digest({"stage": stage.name, "version": stage.version_of(config), "settings": keyed, "in": digests})


def stage_status(stage: Stage, folder: Path, config: Any, wanted: str | None = None) -> str:
    """Return `missing`, `done`, `stale` (inputs or code changed since) or `other settings`.

    Without the `wanted` key only the settings are compared.
    """
    if not exists(folder / MANIFEST):
        return "missing"
    manifest = read_manifest(folder)
    if manifest["settings"] != stage.keyed(stage.of(config)):
        return "other settings"
    current = manifest["version"] == stage.version_of(config) if wanted is None else manifest["key"] == wanted
    return "done" if current else "stale"


def has_files(folder: Path, names: Collection[str]) -> bool:
    """Return whether files of a stage are there, in its folder or packed."""
    return all(exists(folder / name) for name in names)


def _origin() -> dict[str, Any]:
    """Return the provenance of a result: of the code that is running, so read before a run of hours, not after it."""
    return {
        "command": provenance.command_line(),
        "git_revision": provenance.git_revision(),
        "versions": provenance.versions(),
    }


def _finish(
    stage: Stage, folder: Path, temporary: Path, config: Any, wanted: str, seconds: float, origin: dict[str, Any]
) -> None:
    """Write the manifest of a result and put the result in its place."""
    outputs = {path.name: file_digest(path) for path in sorted(temporary.iterdir())}
    write_json(
        temporary / MANIFEST,
        {
            "stage": stage.name,
            "version": stage.version_of(config),
            "key": wanted,
            "settings": stage.keyed(stage.of(config)),
            "outputs": outputs,
            "output_digest": digest(outputs),
            "seconds": seconds,
            **origin,
        },
    )
    _put(temporary, folder)


def _input_folder(run_dir: Path, name: str, stage: Stage, rerun_command: str) -> Path:
    folder = run_dir / name
    if not exists(folder / MANIFEST):
        raise MissingInputError(
            f"stage {stage.name} needs stage {name}, and {folder} holds no finished result of it\nRun: {rerun_command}"
        )
    return folder


def _other_settings(stage: Stage, folder: Path, config: Any) -> OtherSettingsError:
    old = read_manifest(folder)["settings"]
    changes = setting_differences(stage.keyed(stage.of(config)), old)
    lines = [f"  {key}: there was {was!r}, asked for {now!r}" for key, (now, was) in changes.items()]
    return OtherSettingsError(
        "\n".join([f"{folder} was made with other settings, which are never overwritten:", *lines])
        + "\nGive the change on the command line (it gets a folder of its own), set results_dir=PATH, "
        f"or delete {folder if folder.exists() else folder.parent}."
    )


def _twin(run_dir: Path, name: str, wanted: str) -> Path | None:
    """Return the folder of a sibling run (same place, other overrides) that already holds this very result, whole."""
    for folder in (sibling / name for sibling in sorted(run_dir.parent.iterdir())):
        with suppress(PipelineError):  # a damaged sibling is reported by its own run
            if exists(folder / MANIFEST) and read_manifest(folder)["key"] == wanted and is_whole(folder):
                return folder
    return None


def _copy_twin(twin: Path, folder: Path, derive: Derive | None) -> None:
    verified_manifest(twin)
    with unfinished(folder) as temporary:
        with opened(twin.parent, [twin.name], derive) as whole:
            shutil.copytree(whole / twin.name, temporary, dirs_exist_ok=True)
        _put(temporary, folder)


def _put(temporary: Path, folder: Path) -> None:
    """Put a whole result in its place; an existing one is stale: of an older version of the stage, or its inputs."""
    if folder.exists():
        shutil.rmtree(folder)
    temporary.rename(folder)


def _result_lock(config: Any, stage: Stage, wanted: str) -> Path:
    """Return the lock of a result, whichever run makes it."""
    return Path(config.results_dir) / "locks" / f"{stage.name}-{wanted[:16]}.lock"


@contextmanager
def _lock(path: Path, busy: str = "") -> Iterator[bool]:
    """Hold a lock file; where another process has it, give False, or with the message `busy` print it and wait."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        if busy:
            print(f"{busy}; waiting for it", flush=True)
            lock.acquire()
    try:
        yield lock.is_locked
    finally:
        lock.release()
