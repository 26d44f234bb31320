"""`otr-tabulate`: tables and figures from the runs and fits that are there."""

import argparse
import dataclasses
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pipelines.cli.runs import load_config
from pipelines.cli.settings import settings_of
from pipelines.config.setting import Count, Folder, FreeText, OneOf, check_settings, results_folder
from pipelines.errors import ConfigError, MissingInputError
from pipelines.runs.replay import replay


@dataclass(frozen=True)
class TabulateConfig:
    """What `otr-tabulate` takes."""

    table: FreeText = "4.1"
    figure: FreeText | None = None
    # This and the next three: of the figures that show the runs that one names
    run: list[FreeText] = field(default_factory=list)
    tree: FreeText = "pruned"
    inputs: list[FreeText] = field(default_factory=list)
    out: FreeText | None = None
    budget: Annotated[str | None, OneOf("standard", "thesis", "quick", "smoke")] = None  # of Figures 4.6 and 4.7
    evaluate: bool = False
    n_workers: Count | None = None
    results_dir: Folder = field(default_factory=results_folder)
    debug: bool = False

    def __post_init__(self) -> None:
        check_settings(self)


def do(arguments: argparse.Namespace) -> int:
    """Write the reports that are named, print them, and return whether runs that were played again differed."""
    from pipelines.report.figures.run_figures import RUN_FIGURES, RunFigure  # imports pandas, as the next
    from pipelines.report.tabulate import FIGURES_OF_A_BUDGET, reports_of, write_report

    names = [argument for argument in arguments.overrides if "=" not in argument]
    cfg: TabulateConfig = settings_of(TabulateConfig, [each for each in arguments.overrides if each not in names])
    asked = names or [f"figure={cfg.figure}" if cfg.figure else f"table={cfg.table}"]
    reports = [report for name in asked for report in reports_of(name)]
    results_dir = Path(cfg.results_dir)
    of_runs = RunFigure(cfg.run, cfg.tree, cfg.inputs, cfg.out)
    given = {"budget": cfg.budget, **dataclasses.asdict(of_runs)}
    unset = {"budget": None, **dataclasses.asdict(RunFigure([]))}
    takers = {"budget": FIGURES_OF_A_BUDGET, "tree": ("regions",), "inputs": ("regions",)}
    for setting, value in given.items():
        known = takers.get(setting, tuple(RUN_FIGURES))
        if value != unset[setting] and not set(known) & set(reports):
            take = "takes" if len(known) == 1 else "take"
            raise ConfigError(f"{setting}={value}: only figure={', figure='.join(known)} {take} it")
    if not (results_dir / "runs").is_dir() and not RUN_FIGURES.keys() >= set(reports):
        raise ConfigError(f"results_dir={cfg.results_dir}: there is no folder {results_dir / 'runs'} with runs")
    different = 0
    if cfg.evaluate:
        for run_dir in sorted(path.parent for path in results_dir.glob("runs/*/*/depth-*/**/summary.json")):
            config = dataclasses.replace(load_config(run_dir, cfg.n_workers), results_dir=cfg.results_dir)
            different += replay(config, run_dir)
    for report in reports:
        try:
            if report in RUN_FIGURES:
                written = RUN_FIGURES[report](of_runs, results_dir, lambda run_dir: load_config(run_dir, 1))
            else:
                written = write_report(report, results_dir, cfg.budget, lambda run_dir: load_config(run_dir, 1))
        except MissingInputError as error:
            if "all" not in names:
                raise
            print(f"{report} is left out: {error}", file=sys.stderr)
            continue
        for path in written:
            print(path)
            if path.suffix in (".md", ".txt"):
                print(f"\n{path.read_text(encoding='utf-8')}")
    return 1 if different else 0
