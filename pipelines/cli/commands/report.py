"""`otr-report`: finished runs as one HTML page."""

import argparse
import functools
from dataclasses import dataclass, field
from pathlib import Path

from pipelines.cli.overrides import key_of
from pipelines.cli.runs import RUN, load_config
from pipelines.cli.settings import settings_of
from pipelines.cli.workflow import Workflow
from pipelines.config.setting import Folder, FreeText, check_settings, results_folder
from pipelines.errors import ConfigError
from pipelines.runs.finished_run import TREES, find_run


@dataclass(frozen=True)
class ReportConfig:
    """What `otr-report` takes; overrides with other keys are those of a run."""

    run: list[FreeText] = field(default_factory=list)  # none for all of results_dir
    tree: FreeText | None = None  # the polished one where that gained, else the pruned
    out: FreeText | None = None
    gallery: FreeText | None = None  # a folder
    results_dir: Folder = field(default_factory=results_folder)
    debug: bool = False

    def __post_init__(self) -> None:
        check_settings(self)


OF_PAGE = ("run", "tree", "out", "gallery")
OWN = (*OF_PAGE, "results_dir", "debug")


def do(arguments: argparse.Namespace) -> int:
    """Write the page of all results, of the runs that are named, or of the run that other overrides ask for.

    With a gallery, its pages and their index.
    """
    from pipelines.report.webpage.gallery import write_gallery
    from pipelines.report.webpage.page import write_results_page, write_run_page  # imports pandas

    own = [override for override in arguments.overrides if key_of(override) in OWN]
    of_run = [override for override in arguments.overrides if key_of(override) not in OF_PAGE]
    cfg: ReportConfig = settings_of(ReportConfig, own)
    if cfg.tree is not None and cfg.tree not in TREES[:5]:
        raise ConfigError(f"tree={cfg.tree}: the page shows {', '.join(TREES[:5])}")
    results_dir = Path(cfg.results_dir)
    RUN.check_keys(of_run, OWN)
    is_of_run = any(key_of(override) not in OWN for override in of_run)
    if is_of_run and cfg.run:
        raise ConfigError(f"run={cfg.run[0]} and {of_run[0]}: an existing run, or one to make; leave one of them out")
    folders = [_done(RUN, of_run)] if is_of_run else [find_run(run, cfg.results_dir) for run in cfg.run]
    if not folders and cfg.tree is not None:
        raise ConfigError(f"tree={cfg.tree}: of which run? Add run=FOLDER")
    config_of = functools.cache(functools.partial(load_config, n_workers=1))
    if cfg.gallery:
        if folders or cfg.out:
            raise ConfigError(f"gallery={cfg.gallery}: it chooses its runs and files; leave the other settings out")
        print(f"{write_gallery(results_dir, Path(cfg.gallery), config_of)}: open it in any browser")
        return 0
    out = Path(cfg.out) if cfg.out else (folders[0] if len(folders) == 1 else results_dir) / "page.html"
    if out.is_dir():
        out /= "page.html"
    if folders:
        path = write_run_page(folders, cfg.tree, out, config_of)
    else:
        path = write_results_page(results_dir, out, config_of)
    print(f"{path}: {path.stat().st_size / 2**20:.1f} MB, open it in any browser")
    return 0


def _done(workflow: Workflow, overrides: list[str]) -> Path:
    """Do the run that the overrides ask for, as far as it is not done, and return its folder."""
    (job,) = workflow.jobs(workflow.expand(overrides, multirun=False))
    workflow.check(job.config)
    workflow.do(job)
    return job.run_dir
