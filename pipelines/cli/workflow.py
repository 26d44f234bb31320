"""What a command does with its words: composes them, and has the jobs that come out done."""

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig

from pipelines.cli.compose import Composer, parse
from pipelines.engine.job import Job


@dataclass(frozen=True)
class Workflow:
    """What a command does with its words: how they are composed, and how the jobs that come out are done.

    Attributes:
        program: the command.
        composer: composes the words.
        job: from a composed configuration and its words to the job.
        groups: positions of the jobs that are done in one process, group by group.
        do: does one job.
        do_group: does the jobs of a group and returns what each failed with.
        check: raises where something that the jobs need is not installed.
    """

    program: str
    composer: Composer
    job: Callable[[DictConfig, Sequence[str]], Job]
    groups: Callable[[Sequence[Any]], list[list[int]]]
    do: Callable[[Any], Any]
    do_group: Callable[[Sequence[Any]], list[Exception | None]]
    check: Callable[[Any], None]

    def jobs(self, words: Sequence[list[str]]) -> list[Job]:
        """Return the jobs with these overrides; those that differ in their seed alone are composed once."""
        composed: dict[tuple[str, ...], DictConfig] = {}
        jobs = []
        for job in words:
            seeds = [word for word in job if word.startswith("seed=")]
            rest = tuple(word for word in job if word not in seeds)
            if len(seeds) == 1 and rest in composed:
                composed[rest].seed = parse(seeds[0]).value()
            else:
                composed[rest] = self.composer.compose(job)
            jobs.append(self.job(composed[rest], job))
        return jobs


def command_of(program: str, overrides: Sequence[str]) -> str:
    """Return the command that does one job, as it is recorded beside what it makes."""
    return shlex.join([program, *(word for word in overrides if word.split("=")[0] not in ("stages", "hydra.mode"))])
