"""The commands, from `otr-run` to `otr-verify`; how Hydra's launchers start jobs."""

import argparse
import dataclasses
import functools
import io
import itertools
import os
import re
import shlex
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from otr import OtrError
from pipelines import config as schemas
from pipelines.compose import CONF_DIR, Composer, parse, readable, schema_of, to_object
from pipelines.config import RunConfig
from pipelines.errors import ConfigError, PipelineError
from pipelines.export import ExportConfig, check_export, find_run, program_of, write_program
from pipelines.figure_runs import EXPERIMENT, FIGURES, RUNS_OF_FIGURE, budget_of_runs, check_figure
from pipelines.fleet.groups import fleets
from pipelines.help import HELP
from pipelines.job import Job, record_failure
from pipelines.methods import METHODS, imitates, is_soft
from pipelines.parse import policy_tree
from pipelines.plan import print_plan
from pipelines.program_files import read_program
from pipelines.replay import replay
from pipelines.run import RunJob, run_job, run_jobs
from pipelines.settings import run_folder
from pipelines.store import corrupt
from pipelines.supervised.config import LEARNERS, FitConfig, fit_folder
from pipelines.supervised.config import DataConfig as FitDataConfig
from pipelines.supervised.run import FitJob, fit_groups, fit_job, fit_jobs
from pipelines.sweep import Outcome, how_to_use, is_sweep_word, quoted, run_sweep, side_by_side, write_jobs
from pipelines.tabulate import write_table
from pipelines.tracking import check_tracking
from pipelines.verify import VerifyConfig, verify_run

# What a job's settings depend on outside of its words; a cluster's processes have not inherited it. No secrets here:
# launchers write tasks to disk.
CARRIED_VARIABLES = (
    "OTR_RESULTS_DIR", "OTR_DATA_DIR", "XDG_DATA_HOME", "MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME",
)  # fmt: skip
# The groups and keys that decide how an oracle is trained, and where and how that is done.
OF_TRAINING = ("env", "algo", "actor", "trainer", "budget", "train", "seed", "experiment", "results_dir", "n_workers",
               "side_by_side", "debug", "tracking")  # fmt: skip
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
    budget: schemas.BudgetConfig | None = None


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
        return _sweep(workflow, overrides)
    (job,) = workflow.jobs(composer.expand(overrides, multirun=False))
    workflow.check(job.config)
    try:
        workflow.do(job)
    except (PipelineError, BrokenPipeError):
        raise
    except Exception as error:
        print(f"traceback: {record_failure(job, error, _sweep_name())}", file=sys.stderr)
        raise
    return 0


def _sweep(workflow: Workflow, overrides: list[str]) -> int:
    """Do every job of a sweep; failing ones do not stop the others and are named at the end."""
    words = workflow.composer.expand(overrides, multirun=True)
    if not words:
        raise ConfigError("these words make no job; look for an empty range()")
    jobs = workflow.jobs(words)
    workflow.check(jobs[0].config)
    name = _sweep_name()
    own = [[word for word in job if not is_sweep_word(word) or word.startswith("launcher=")] for job in words]

    def launch(left: Sequence[int]) -> list[Outcome]:
        return _launch(workflow, name, overrides, [jobs[i] for i in left], [own[i] for i in left])

    outcomes = run_sweep(jobs, launch)
    failed = [outcome for outcome in outcomes if outcome.error]
    print(f"\n{len(outcomes)} jobs: {len(outcomes) - len(failed)} done, {len(failed)} failed")
    for outcome in failed:
        print(f"  {outcome.folder}: {outcome.error}")
        if outcome.traceback:
            print(f"    traceback: {outcome.traceback}")
    return EXIT_FAILED if failed else 0


def _launch(
    workflow: Workflow, name: str, overrides: list[str], jobs: Sequence[Job], words: Sequence[list[str]]
) -> list[Outcome]:
    """Do jobs, each with its own words, under the launcher that the overrides ask for, group by group."""
    groups = workflow.groups([job.config for job in jobs])
    carried = {variable: os.environ.get(variable) for variable in CARRIED_VARIABLES}
    grouped = [[words[i] for i in group] for group in groups]
    task = _SweepTask(workflow.program, name, str(Path.cwd()), carried, grouped)
    # Absolute, because Hydra makes this folder in whatever folder a launcher starts the job.
    sweep_dir = quoted(str(Path(jobs[0].config.results_dir).absolute() / "sweeps"))
    # The launcher's settings are any job's: the first one's, for there are no defaults for what is swept.
    of_hydra = [word for word in overrides if word.lstrip("+").startswith(("hydra.", "hydra/"))]
    asked = workflow.composer.sweep_words([*words[0], *of_hydra, "hydra.mode=MULTIRUN", f"hydra.sweep.dir={sweep_dir}"])
    with workflow.composer.hydra():
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        cfg = hydra.compose_config(workflow.composer.name, asked, run_mode=RunMode.MULTIRUN)
        context = HydraContext(config_loader=hydra.config_loader, callbacks=Callbacks(cfg))
        if "submitit_folder" in cfg.hydra.launcher:
            print(
                f"{len(jobs)} jobs handed over; what they print: {jobs[0].config.results_dir}/sweeps/.submitit",
                flush=True,
            )
        launcher = Plugins.instance().instantiate_launcher(context, task, cfg)
        first_words = [words[group[0]] for group in groups]
        returned = [result.return_value for result in launcher.launch(first_words, initial_job_idx=0)]
    outcomes = dict(zip(itertools.chain(*groups), itertools.chain(*returned), strict=True))
    return [outcomes[i] for i in range(len(jobs))]


@dataclass(frozen=True)
class _SweepTask:
    """Does one group of a sweep's jobs in whatever process a launcher starts; reports failures instead of raising them.

    Attributes:
        program: names the workflow.
        sweep: names the folder of the sweep's failures.
        cwd: where the command was given, which relative paths start from.
        environment: the variables there that settings depend on; None where one is not set.
        groups: the words of every job, group by group; a launcher is given the first of each.
    """

    program: str
    sweep: str
    cwd: str
    environment: dict[str, str | None]
    groups: list[list[list[str]]]

    def __call__(self, cfg: DictConfig) -> list[Outcome]:
        os.chdir(self.cwd)
        for name, value in self.environment.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
        first = list(HydraConfig.get().overrides.task)
        workflow = {"otr-run": RUN, "otr-fit": FIT}[self.program]
        jobs = workflow.jobs(next(group for group in self.groups if group[0] == first))
        if HydraConfig.get().runtime.choices["hydra/launcher"] != "basic":
            jobs = [side_by_side(job) for job in jobs]
        outcomes: list[Outcome] = []
        before = None
        for job, error in zip(jobs, workflow.do_group(jobs), strict=True):
            outcomes.append(self._outcome(job, error, error is not None and error is before))
            before = error
        return outcomes

    def _outcome(self, job: Job, error: Exception | None, is_told: bool) -> Outcome:
        """Return how a job ended; what a group failed with as a whole is told with the first of its jobs alone."""
        if error is None:
            return Outcome(job.folder)
        path = record_failure(job, error, self.sweep)
        message = _message(error)
        if job.config.debug:
            traceback.print_exception(error)
        print(f"{job.folder} failed: {'so, too' if is_told else message}", file=sys.stderr, flush=True)
        return Outcome(job.folder, message.splitlines()[0], path)


def _plan(arguments: argparse.Namespace) -> int:
    words = RUN.composer.expand(list(arguments.overrides), arguments.multirun)
    jobs = [job for job in RUN.jobs(words) if isinstance(job, RunJob)]
    print_plan(jobs)
    if arguments.jobs:
        n_jobs = write_jobs(arguments.jobs, jobs, words)
        print(f"\n{how_to_use(arguments.jobs, n_jobs)}")
    return 0


def _tabulate(arguments: argparse.Namespace) -> int:
    cfg = to_object(TABULATE.compose(list(arguments.overrides)))
    assert isinstance(cfg, TabulateConfig)
    results_dir = Path(cfg.results_dir)
    if not (results_dir / "runs").is_dir():
        raise ConfigError(f"results_dir={cfg.results_dir}: there is no folder {results_dir / 'runs'} with runs")
    different = 0
    if cfg.evaluate:
        for run_dir in sorted(path.parent for path in results_dir.glob("runs/*/*/depth-*/**/summary.json")):
            config = dataclasses.replace(_load_config(run_dir, cfg.n_workers), results_dir=cfg.results_dir)
            different += replay(config, run_dir)
    written = _write_figure(cfg) if cfg.figure else write_table(cfg.table, results_dir)
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
    program = program_of(cfg, _load_config(folder, None), folder)
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
    print(verify_run(cfg, _load_config(folder, None), folder))
    return 0


def _path_quoted(word: str) -> str:
    """Return a word whose value is a path so that Hydra takes it as it is: folders of runs may have a ~ in them."""
    key, equals, value = word.partition("=")
    is_path = (
        key in ("run", "out", "results_dir", "certificate", "tree", "actor")
        and value not in ("", "null")
        and value[0] not in "\"'"
    )
    return f"{key}={quoted(value)}" if equals and is_path else word


def _write_figure(cfg: TabulateConfig) -> list[Path]:
    """Write a figure from the runs of its experiment under one budget."""
    assert cfg.figure is not None
    check_figure(cfg.figure)
    budget = cfg.budget.name if cfg.budget else budget_of_runs(Path(cfg.results_dir))
    own = [f"budget={budget}", f"results_dir={quoted(cfg.results_dir)}"]
    # Both figures show runs of this experiment; the second one needs a part of them.
    words = RUN.composer.expand([f"+experiment={EXPERIMENT}", *own, *RUNS_OF_FIGURE[cfg.figure]], multirun=False)
    runs = [job.config for job in RUN.jobs(words)]
    return FIGURES[cfg.figure](runs, Path(cfg.results_dir))


def run_config(words: Sequence[str]) -> RunConfig:
    """Return the configuration of `otr-run` with these words."""
    return _run_config(tuple(words))


def _run_job(cfg: DictConfig, overrides: Sequence[str]) -> RunJob:
    config = to_object(cfg)
    assert isinstance(config, RunConfig)
    if isinstance(config.method, schemas.ProgramConfig):
        config = _with_program(config, config.method.program, overrides)
        cfg.depth = config.depth
    named = [
        f"env={config.env.name}",
        f"method={config.method.name}",
        f"budget={config.budget.name}",
        f"trainer={config.trainer.name}",
        *(["algo=ars"] if isinstance(config.algo, schemas.ArsConfig) else []),
    ]
    baseline = _run_config((*named, f"depth={config.depth}"))
    oracle = _oracle_job(config, overrides) if imitates(config.method.name) else None
    config = dataclasses.replace(config, oracle_run=oracle.config if oracle else None)
    folder = run_folder(config, dataclasses.replace(baseline, seed=config.seed))
    return RunJob(
        config=dataclasses.replace(config, folder=folder),
        folder=folder,
        config_yaml=OmegaConf.to_yaml(cfg, resolve=True),
        command=_command_of("otr-run", overrides),
        oracle=oracle,
    )


def _with_path_quoted(word: str) -> str:
    """Return `program=PATH`, or several, quoted where Hydra would stumble over the ~ of a run's folder or a space."""
    key, _, value = word.partition("=")
    if key != "program" or re.fullmatch(r"[\w./,-]*", value) or value[:1] in ("'", '"', "[") or "(" in value:
        return word
    return f"{key}={','.join(quoted(path) for path in value.split(','))}"


def _program_spelt_out(words: Sequence[str]) -> list[str]:
    """Return the words with `program=FILE` replaced by what it is short for.

    Hydra would take it for a choice of the group conf/program, where the shipped programs lie.
    """
    methods = [word for word in words if word.startswith("method=") and word != "method=program"]
    named = [word for word in words if word.startswith("program=")]
    if methods and named:
        raise ConfigError(f"{named[0]} is evaluated by method=program, not by {methods[0]}; leave one of them out")
    spelt_out = [word for word in words if not (named and word == "method=program")]
    return [other for word in spelt_out for other in
            (["method=program", f"method.{word}"] if word in named else [word])]  # fmt: skip


def _with_program(config: RunConfig, program: str, overrides: Sequence[str]) -> RunConfig:
    """Return the configuration with its program read, and the depth of that one's tree."""
    text = read_program(program)
    given = [word for word in overrides if word.startswith("depth=")]
    if given:
        raise ConfigError(f"{given[0]}: the depth of a program's tree is its own; leave {given[0]} out")
    depth = policy_tree(text, config.env, program).depth
    return dataclasses.replace(config, program_text=text, depth=depth)


def _implied(overrides: Sequence[str]) -> list[str]:
    """Return what the words imply: the algorithm of soft trees, where they name none (an environment may have one of
    its own), and how long these and augmented random search learn, and how long at a time; and all of that of PID
    policies, which the thesis trains with one hidden neuron and plays for more episodes."""
    given = dict(word.split("=", 1) for word in overrides if "=" in word)
    soft = given.get("method") in METHODS and is_soft(given["method"])
    implied = []
    if soft or given.get("algo") == "ars":
        implied.append('train.steps="${budget.on_policy_steps.${env.task}}"')
        implied.append('train.eval_interval_steps="${budget.on_policy_interval_steps}"')
    if soft and "algo" not in given:
        own = (f"ppo_{given['method']}_{given.get('env', '')}", f"ppo_tree_{given.get('env', '')}")
        files = (name for name in own if (CONF_DIR / "algo" / f"{name}.yaml").is_file())
        implied.append(f"algo={next(files, 'ppo_tree')}")
    if given.get("method") == "pid":
        implied += ["depth=1", 'evaluate.n_episodes="${budget.pid.n_evaluation_episodes}"']
        names = ("steps", "eval_interval_steps", "n_selection_episodes")
        implied += [f'train.{name}="${{budget.pid.{name}}}"' for name in names]
        implied += [] if "algo" in given else ["algo=ddpg_pid"]
    return implied


def _oracle_job(config: RunConfig, overrides: Sequence[str]) -> RunJob:
    """Return the job that trains a job's oracle: method=otr with the oracle's layers as its depth, and as trained."""
    own = [word for word in overrides if word.lstrip("+").split("=")[0].split(".")[0] in OF_TRAINING]
    words = [*(word for word in own if not word.startswith("seed=")), f"depth={config.oracle}".replace(" ", ""),
             "method=otr", "stages=[train]"]  # fmt: skip
    cfg = _composed(tuple(words))
    cfg.seed = config.seed
    return _run_job(cfg, [*words, f"seed={config.seed}"])


@functools.cache
def _composed(words: tuple[str, ...]) -> DictConfig:
    return RUN.composer.compose(words)


@functools.cache
def _run_config(words: tuple[str, ...]) -> RunConfig:
    register_schemas()
    config = to_object(RUN.composer.compose(words))
    assert isinstance(config, RunConfig)
    return config


def _fit_job(cfg: DictConfig, overrides: Sequence[str]) -> Job:
    config = to_object(cfg)
    assert isinstance(config, FitConfig)
    baseline = _fit_config((f"data={config.data.name}", f"method={config.method.name}"))
    folder = fit_folder(config, dataclasses.replace(baseline, seed=config.seed))
    return FitJob(
        config=dataclasses.replace(config, folder=folder),
        folder=folder,
        config_yaml=OmegaConf.to_yaml(cfg, resolve=True),
        command=_command_of("otr-fit", overrides),
    )


@functools.cache
def _fit_config(words: tuple[str, ...]) -> FitConfig:
    config = to_object(FIT.composer.compose(words))
    assert isinstance(config, FitConfig)
    return config


def _command_of(program: str, overrides: Sequence[str]) -> str:
    return shlex.join([program, *(word for word in overrides if word.split("=")[0] not in ("stages", "hydra.mode"))])


def _load_config(run_dir: Path, n_workers: int | None) -> RunConfig:
    """Return the configuration that a finished run was made with."""
    try:
        cfg = OmegaConf.load(run_dir / "config.yaml")
        schema = schema_of(RunConfig)
        schema.algo = schema_of(schemas.ALGORITHMS[cfg.algo.name])
        schema.method = schema_of(schemas.METHOD_CONFIGS[cfg.method.name])
        if "trainer" in cfg:  # there was one trainer only before
            schema.trainer = schema_of(schemas.FleetConfig if "n_envs" in cfg.trainer else schemas.TrainerConfig)
        loaded = to_object(OmegaConf.merge(schema, cfg, {"n_workers": n_workers}))
    except (OSError, KeyError, OmegaConfBaseException, ConfigError) as error:
        raise corrupt(run_dir / "config.yaml", error) from error
    assert isinstance(loaded, RunConfig)
    return loaded


RUN = Workflow(
    "otr-run",
    Composer(
        "run",
        groups=("env", "algo", "method", "trainer", "budget", "launcher", "experiment"),
        needs="env",
        anything="pendulum",
        schemas={
            (None, "run_schema"): RunConfig,
            (None, "env_schema"): schemas.EnvConfig,
            (None, "method_schema"): schemas.MethodConfig,
            **{("method", f"run_{name}_schema"): method for name, method in schemas.METHOD_CONFIGS.items()},
            (None, "budget_schema"): schemas.BudgetConfig,
            **{("algo", f"{name}_schema"): algorithm for name, algorithm in schemas.ALGORITHMS.items()},
            **{("trainer", f"{name}_schema"): trainer for name, trainer in schemas.TRAINERS.items()},
        },
        implied=_implied,
        shorthand=_program_spelt_out,
        short=("program", "column"),
    ),
    job=_run_job,
    groups=fleets,
    do=run_job,
    do_group=run_jobs,
    check=check_tracking,
)
FIT = Workflow(
    "otr-fit",
    Composer(
        "fit",
        folder="fit",
        groups=("data", "method", "launcher", "experiment"),
        needs="data",
        anything="bace",
        schemas={
            (None, "fit_schema"): FitConfig,
            (None, "data_schema"): FitDataConfig,
            **{("method", f"{name}_schema"): learner for name, learner in LEARNERS.items()},
        },
    ),
    job=_fit_job,
    groups=fit_groups,
    do=fit_job,
    do_group=fit_jobs,
    check=lambda config: None,
)
TABULATE = Composer("tabulate", groups=("budget",), schemas={(None, "tabulate_schema"): TabulateConfig})
EXPORT = Composer("export", schemas={(None, "export_schema"): ExportConfig})
VERIFY = Composer("verify", schemas={(None, "verify_schema"): VerifyConfig})


def register_schemas() -> None:
    """Tell Hydra the dataclasses that the files in conf/ build on."""
    for composer in (RUN.composer, FIT.composer, TABULATE, EXPORT, VERIFY):
        composer.register()


def _sweep_name() -> str:
    return time.strftime("%Y-%m-%d_%H-%M-%S")


def _command_line(program: str) -> str:
    return shlex.join([program, *sys.argv[1:]])


def _complain(program: str, error: Exception, debug: bool, code: int) -> int:
    if debug:
        traceback.print_exception(error)
    print(f"{program}: {_message(error)}", file=sys.stderr)
    return code


def _message(error: Exception) -> str:
    """Return the message alone where it was written for people, with the error's kind where it was not."""
    foreseen = isinstance(error, PipelineError | HydraException | OtrError)
    if isinstance(error, OmegaConfBaseException):
        return readable(str(error))
    return str(error) if foreseen else f"{type(error).__name__}: {error}"
