"""The commands, from `otr-run` to `otr-verify`."""

import argparse
import dataclasses
import functools
import io
import json
import os
import re
import shlex
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pipelines.cli.compose import Composer, to_object
from pipelines.cli.fits import FIT
from pipelines.cli.help import HELP
from pipelines.cli.messages import message_of
from pipelines.cli.runs import RUN, load_config, run_config
from pipelines.cli.sweeps import do_sweep, sweep_name
from pipelines.cli.workflow import Workflow
from pipelines.config import BudgetConfig
from pipelines.engine.digests import differences_suffix
from pipelines.engine.job import record_failure
from pipelines.engine.sweep import how_to_use, quoted, write_jobs
from pipelines.errors import ConfigError, MissingInputError, PipelineError
from pipelines.report.export import ExportConfig, check_export, find_run, program_of, write_program
from pipelines.report.plan import print_plan
from pipelines.report.replay import replay
from pipelines.report.verify import VerifyConfig, verify_run
from pipelines.stages.run_job import RunJob

if TYPE_CHECKING:
    from pipelines.report.figure_4_6 import Planned

EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED, EXIT_BROKEN_PIPE, EXIT_TERMINATED = 1, 2, 130, 141, 143


@dataclass(frozen=True)
class TabulateConfig:
    """What `otr-tabulate` takes."""

    table: str
    figure: str | None
    results_dir: str
    evaluate: bool
    n_workers: int | None
    debug: bool
    budget: BudgetConfig | None = None


TABULATE = Composer("tabulate", groups=("budget",), schemas={(None, "tabulate_schema"): TabulateConfig})
EXPORT = Composer("export", schemas={(None, "export_schema"): ExportConfig})
VERIFY = Composer("verify", schemas={(None, "verify_schema"): VerifyConfig})


def run() -> None:
    """Entry point of `otr-run`."""
    _main("otr-run", lambda arguments: _do(RUN, arguments))


def plan() -> None:
    """Entry point of `otr-plan`."""
    _main("otr-plan", _plan)


def fit() -> None:
    """Entry point of `otr-fit`."""
    _main("otr-fit", lambda arguments: _do(FIT, arguments))


def tabulate() -> None:
    """Entry point of `otr-tabulate`."""
    _main("otr-tabulate", _tabulate)


def export() -> None:
    """Entry point of `otr-export`."""
    _main("otr-export", _export)


def verify() -> None:
    """Entry point of `otr-verify`."""
    _main("otr-verify", _verify)


def _main(program: str, command: Callable[[argparse.Namespace], int]) -> None:
    """Run a command, turning every foreseen failure into one message on stderr and an exit code."""
    parser = argparse.ArgumentParser(
        program, description=HELP[program], formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    if program not in ("otr-tabulate", "otr-export", "otr-verify"):
        parser.add_argument(
            "-m", "--multirun", action="store_true", help="sweep over comma lists, range() and choice()"
        )
        parser.add_argument("--cfg", action="store_true", help="print the resolved configuration and stop")
    if program == "otr-plan":
        parser.add_argument(
            "--jobs", type=Path, metavar="FILE", help="also write one command a line, for xargs or sbatch --array"
        )
    arguments = parser.parse_intermixed_args()
    arguments.overrides = [_with_path_quoted(word) for word in arguments.overrides]
    debug = "debug=true" in (word.lower() for word in arguments.overrides)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(EXIT_TERMINATED))  # so that workers are ended, too
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        register_schemas()
        code = command(arguments)
    except KeyboardInterrupt:
        print(f"\nstopped; what was finished is kept, and the same command goes on from it: {_command_line(program)}")
        code = EXIT_INTERRUPTED
    except BrokenPipeError:  # the reader of a pipe has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = EXIT_BROKEN_PIPE
    except (ConfigError, HydraException, OmegaConfBaseException) as error:
        code = _complain(program, error, debug, EXIT_USAGE)
    except Exception as error:  # the last resort of a command line: no traceback unless asked for
        code = _complain(program, error, debug, EXIT_FAILED)
    sys.exit(code)


def _do(workflow: Workflow, arguments: argparse.Namespace) -> int:
    composer, overrides = workflow.composer, list(arguments.overrides)
    is_sweep, _ = composer.sweep_parameters(overrides, arguments.multirun)
    if arguments.cfg:
        first = composer.expand(overrides, arguments.multirun)[0]
        print(OmegaConf.to_yaml(composer.compose(first), resolve=True))
        return 0
    if is_sweep:
        return 0 if do_sweep(workflow, overrides) else EXIT_FAILED
    (job,) = workflow.jobs(composer.expand(overrides, multirun=False))
    workflow.check(job.config)
    try:
        workflow.do(job)
    except (PipelineError, BrokenPipeError):
        raise
    except Exception as error:
        print(f"traceback: {record_failure(job, error, sweep_name())}", file=sys.stderr)
        raise
    return 0


def _plan(arguments: argparse.Namespace) -> int:
    words = RUN.composer.expand(list(arguments.overrides), arguments.multirun)
    jobs = [job for job in RUN.jobs(words) if isinstance(job, RunJob)]
    print_plan(jobs)
    if arguments.jobs:
        n_jobs = write_jobs(arguments.jobs, jobs, words)
        print(f"\n{how_to_use(arguments.jobs, n_jobs)}")
    return 0


def _tabulate(arguments: argparse.Namespace) -> int:
    from pipelines.report.tabulate import reports_of, write_report  # imports pandas

    names = [word for word in arguments.overrides if "=" not in word]
    cfg = to_object(TABULATE.compose([word for word in arguments.overrides if "=" in word]))
    assert isinstance(cfg, TabulateConfig)
    words = names or [f"figure={cfg.figure}" if cfg.figure else f"table={cfg.table}"]
    reports = [report for word in words for report in reports_of(word)]
    results_dir = Path(cfg.results_dir)
    if not (results_dir / "runs").is_dir():
        raise ConfigError(f"results_dir={cfg.results_dir}: there is no folder {results_dir / 'runs'} with runs")
    different = 0
    if cfg.evaluate:
        for run_dir in sorted(path.parent for path in results_dir.glob("runs/*/*/depth-*/**/summary.json")):
            config = dataclasses.replace(load_config(run_dir, cfg.n_workers), results_dir=cfg.results_dir)
            different += replay(config, run_dir)
    budget = cfg.budget.name if cfg.budget else None
    for report in reports:
        try:
            written = write_report(report, results_dir, budget, _planned, lambda run_dir: load_config(run_dir, 1))
        except MissingInputError as error:
            if "all" not in names:
                raise
            print(f"{report} is left out: {error}", file=sys.stderr)
            continue
        for path in written:
            print(path)
            if path.suffix in (".md", ".txt"):
                print(f"\n{path.read_text(encoding='utf-8')}")
    return EXIT_FAILED if different else 0


def _export(arguments: argparse.Namespace) -> int:
    """Print a run's policy as a program, or write it to a file."""
    words = [_path_quoted(word) for word in arguments.overrides]
    cfg = to_object(EXPORT.compose(words))
    assert isinstance(cfg, ExportConfig)
    check_export(cfg)
    folder = find_run(cfg.run, cfg.results_dir)
    program = program_of(cfg, load_config(folder, None), folder)
    if cfg.out is not None:
        print(write_program(cfg, program))
    else:
        assert isinstance(program, str)
        sys.stdout.write(program)
    return 0


def _verify(arguments: argparse.Namespace) -> int:
    """Check a run's certificate."""
    cfg = to_object(VERIFY.compose([_path_quoted(word) for word in arguments.overrides]))
    assert isinstance(cfg, VerifyConfig)
    folder = find_run(cfg.run, cfg.results_dir)
    print(verify_run(cfg, load_config(folder, None), folder))
    return 0


@functools.cache
def _planned(budget: str) -> list["Planned"]:
    """Return the runs of the experiment that figures show; its overrides are the parts of their folders' names."""
    from pipelines.report.figure_4_6 import ENVIRONMENT, EXPERIMENT, Planned

    words = RUN.composer.expand([f"+experiment={EXPERIMENT}", f"budget={budget}"], multirun=False)
    usual = run_config([f"env={ENVIRONMENT}", "method=viper", f"budget={budget}"]).oracle
    planned = []
    for job in words:
        given = dict(word.split("=", 1) for word in job)
        oracle = json.loads(given["oracle"])
        seed = f"seed-{given['seed']}{differences_suffix({'oracle': oracle}, {'oracle': usual})}"
        run = f"{ENVIRONMENT}/{given['method']}/depth-{given['depth']}/{budget}/{seed}"
        planned.append(Planned(given["oracle"], given["method"], int(given["depth"]), run))
    return planned


def _with_path_quoted(word: str) -> str:
    """Return `program=PATH`, or several, quoted where Hydra would stumble over the ~ of a run's folder or a space."""
    key, _, value = word.partition("=")
    if key != "program" or re.fullmatch(r"[\w./,-]*", value) or value[:1] in ("'", '"', "[") or "(" in value:
        return word
    return f"{key}={','.join(quoted(path) for path in value.split(','))}"


def _path_quoted(word: str) -> str:
    """Return a word whose value is a path so that Hydra takes it as it is: folders of runs may have a ~ in them."""
    key, equals, value = word.partition("=")
    is_path = (
        key in ("run", "out", "results_dir", "certificate", "tree", "actor")
        and value not in ("", "null")
        and value[0] not in "\"'"
    )
    return f"{key}={quoted(value)}" if equals and is_path else word


def register_schemas() -> None:
    """Tell Hydra the dataclasses that the files in conf/ build on."""
    for composer in (RUN.composer, FIT.composer, TABULATE, EXPORT, VERIFY):
        composer.register()


def _command_line(program: str) -> str:
    return shlex.join([program, *sys.argv[1:]])


def _complain(program: str, error: Exception, debug: bool, code: int) -> int:
    if debug:
        traceback.print_exception(error)
    print(f"{program}: {message_of(error)}", file=sys.stderr)
    return code
