"""A job: one configuration, the folder that it names, the stages it takes, and what is kept of a failure."""

import dataclasses
import errno
import re
import shlex
import sysconfig
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import otr
from otr import OtrError
from pipelines.engine.archive import MANIFEST, Derive, verified_manifest
from pipelines.engine.console import duration
from pipelines.engine.stage import Stage, run_stage, stage_key, stage_status
from pipelines.engine.store import CONFIG, SUMMARY, archive_files, exists, read_json, write_json, write_text
from pipelines.errors import PipelineError

# Where code is that is not a user's: these packages, Python's and what pip installs.
_INSTALLED = (Path(__file__).parents[1], Path(otr.__file__).parent, *map(Path, sysconfig.get_paths().values()))


@dataclass(frozen=True)
class Job(ABC):
    """What is done in one folder. A job is composed once and is plain data, so that any process can do it."""

    program: ClassVar[str]  # the command that does such jobs
    ends_with: ClassVar[str]  # the stage after which the job's summary is written

    config: Any  # what is asked: a `RunConfig` or a `FitConfig`
    folder: str  # the job's folder, relative to `config.results_dir`
    config_yaml: str  # the resolved configuration as text
    overrides: tuple[str, ...] = ()  # what the job was composed from

    @property
    def command(self) -> str:
        """The command that does this job and all its stages."""
        left_out = ("stages=", "launcher=", "hydra.launcher.", "hydra.mode=")  # of a part of the job, or of its sweep
        own = (override for override in self.overrides if not override.startswith(left_out))
        return shlex.join([self.program, *own])

    @property
    def run_dir(self) -> Path:
        """The job's folder."""
        return Path(self.config.results_dir) / self.folder

    @property
    @abstractmethod
    def stages(self) -> tuple[Stage, ...]:
        """The stages that are asked for, in order."""

    @property
    def ends(self) -> bool:
        """Whether the job comes to the stage after which its summary is written."""
        return any(stage.name == self.ends_with for stage in self.stages)

    def side_by_side(self) -> Self:
        """Return a job for which others share its terminal and its cores."""
        config = dataclasses.replace(self.config, side_by_side=True, n_workers=self.config.n_workers or 1)
        return dataclasses.replace(self, config=config)

    def found_done(self) -> None:  # noqa: B027 - nothing to do for most
        """Do what even a finished job needs."""


J = TypeVar("J", bound=Job)


def do_stage(job: Job, stage: Stage, derive: Derive | None = None, needed: Collection[str] = ()) -> None:
    """Bring a stage of a job up to date, write the job's config.yaml, and print how long the stage took."""
    result = run_stage(stage, job.run_dir, job.config, job.command, derive, needed)
    if not exists(job.run_dir / CONFIG):
        write_text(job.run_dir / CONFIG, job.config_yaml)
    print(f"{stage.name}: {'done before' if result.skipped else duration(result.seconds)}", flush=True)


def write_config(job: Job) -> None:
    """Write a job's config.yaml, so that a running job can be inspected; rewrite it while no stage is finished."""
    path = job.run_dir / CONFIG
    if not exists(path) or not _has_finished_a_stage(job):
        write_text(path, job.config_yaml)


def withdraw_config(job: Job) -> None:
    """Remove config.yaml of a job that was refused before any of its stages was finished."""
    if not _has_finished_a_stage(job):
        (job.run_dir / CONFIG).unlink(missing_ok=True)


def _has_finished_a_stage(job: Job) -> bool:
    return bool(archive_files(job.run_dir)) or any(job.run_dir.glob(f"[!.]*/{MANIFEST}"))


def write_summary(job: Job, summary: dict[str, Any]) -> None:
    """Write the summary of a finished job; remove the error of an earlier attempt."""
    write_json(job.run_dir / SUMMARY, summary)
    (job.run_dir / "error.log").unlink(missing_ok=True)


def failure(do: Callable[[J], Any], job: J) -> Exception | None:
    """Do a job and return what it failed with, None if it did not."""
    try:
        do(job)
    except Exception as error:
        return error
    return None


def has_summary(job: Job) -> bool:
    """Return whether a job has its summary, whole, if it comes to the stage after which that is written."""
    try:
        return not job.ends or "seconds" in read_json(job.run_dir / SUMMARY)
    except PipelineError:
        return False


def is_done(job: Job) -> bool:
    """Return whether nothing of a job is left to do, having compared every file with its recorded sha256."""
    if not has_summary(job):
        return False
    ends = job.ends
    gone = {stage.name for stage in job.stages if _is_gone(job, stage)}
    left = [stage for stage in job.stages if stage.name not in gone]
    try:
        if ends and not {stage.name for stage in left} <= read_json(job.run_dir / SUMMARY)["seconds"].keys():
            return False  # a single stage was added since, as by stages=[polish]
        return all(_is_stage_done(job, stage, gone) for stage in left)
    except PipelineError:  # damaged: doing the job reports what is wrong
        return False


def _is_gone(job: Job, stage: Stage) -> bool:
    """Return whether a stage's result only served the stages after it, which are done."""
    later = [other for other in job.stages if stage.name in other.inputs]
    return (
        stage.is_transient
        and not exists(job.run_dir / stage.name / MANIFEST)
        and bool(later)
        and all(stage_status(other, job.run_dir / other.name, job.config) == "done" for other in later)
    )


def _is_stage_done(job: Job, stage: Stage, gone: set[str]) -> bool:
    folder = job.run_dir / stage.name
    if stage_status(stage, folder, job.config) != "done":
        return False
    verified_manifest(folder)
    if gone.intersection(stage.inputs):
        return True
    inputs = {name: job.run_dir / name for name in stage.inputs}
    return stage_status(stage, folder, job.config, stage_key(stage, job.config, inputs)) == "done"


def message_of(error: Exception) -> str:
    """Return the message of an error of ours, and any other with the error's type."""
    if isinstance(error, PipelineError | OtrError):
        return str(error)
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}{_place_of(error)}"
    return f"{type(error).__name__}: {error}{_place_of(error)}"


def _place_of(error: Exception) -> str:
    """Return where an error was raised in code that is neither ours nor installed, such as a custom environment."""
    text = "".join(traceback.format_exception(error))  # has the frames of another process, too
    frames = re.findall(r'File "([^"<>]+)", line (\d+), in (\S+)', text)
    own = [frame for frame in frames if not _is_installed(Path(frame[0]))]
    return f" ({own[-1][0]}, line {own[-1][1]}, in {own[-1][2]})" if own else ""


def _is_installed(path: Path) -> bool:
    return any(path.is_relative_to(folder) for folder in _INSTALLED)


def record_failure(job: Job, error: BaseException, sweep: str) -> str:
    """Write a failed job's traceback to `results/failures/<sweep>/`, whose path is returned, and to its `error.log`."""
    text = f"{job.command}\n\n{''.join(traceback.format_exception(error))}"
    path = Path(job.config.results_dir) / "failures" / sweep / f"{job.folder.replace('/', '_')}.txt"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
        if job.run_dir.is_dir():
            write_text(job.run_dir / "error.log", text)
    except OSError as reason:
        return f"not written ({reason.strerror}); debug=true shows it"
    return str(path)


@contextmanager
def disk_errors_explained(job: Job) -> Iterator[None]:
    """Turn an error of the operating system into a message with the remedy; a missing file keeps its own."""
    try:
        yield
    except (BrokenPipeError, FileNotFoundError):  # the latter comes from a custom environment, if at all
        raise
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        remedy = "Make room there or choose" if full else "Choose"
        raise PipelineError(
            f"{job.run_dir}: {error.strerror or error}{f' ({error.filename})' if error.filename else ''}\n"
            f"{remedy} another place with results_dir=PATH. Finished stages and checkpoints are kept here: with "
            "this place writable again, the same command goes on from them."
        ) from error
