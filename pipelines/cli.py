"""The commands `otr-run`, `otr-plan` and `otr-tabulate`. The only module that knows Hydra and OmegaConf."""

import argparse
import dataclasses
import difflib
import functools
import io
import itertools
import os
import shlex
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra._internal.callbacks import Callbacks
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from otr import OtrError
from pipelines import config as schemas
from pipelines.config import RunConfig, run_folder
from pipelines.errors import ConfigError, PipelineError
from pipelines.fleet.groups import fleets
from pipelines.help import HELP
from pipelines.plan import print_plan
from pipelines.replay import replay
from pipelines.run import Job, record_failure, run_job, run_jobs
from pipelines.store import corrupt
from pipelines.sweep import (
    Outcome,
    check_launcher,
    how_to_use,
    is_sweep_word,
    quoted,
    run_sweep,
    side_by_side,
    write_jobs,
)
from pipelines.tabulate import write_table
from pipelines.tracking import check_tracking

_PACKAGED = Path(__file__).parent / "conf"  # in a wheel; in a checkout conf/ is beside the packages
CONF_DIR = _PACKAGED if _PACKAGED.is_dir() else Path(__file__).parent.parent / "conf"
GROUPS = ("env", "algo", "method", "trainer", "budget", "launcher", "experiment")
# What a job's settings depend on outside of its words; a cluster's processes have not inherited it. No secrets here:
# launchers write tasks to disk.
CARRIED_VARIABLES = ("OTR_RESULTS_DIR", "MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME")
EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED, EXIT_BROKEN_PIPE, EXIT_TERMINATED = 1, 2, 130, 141, 143


@dataclass(frozen=True)
class TabulateConfig:
    """What `otr-tabulate` takes."""

    table: str
    results_dir: str
    evaluate: bool
    n_workers: int | None
    debug: bool


def run() -> None:
    """Entry point of `otr-run`."""
    _main("otr-run", _run)


def plan() -> None:
    """Entry point of `otr-plan`."""
    _main("otr-plan", _plan)


def tabulate() -> None:
    """Entry point of `otr-tabulate`."""
    _main("otr-tabulate", _tabulate)


def _main(program: str, command: Callable[[argparse.Namespace], int]) -> None:
    """Run a command, turning every foreseen failure into one message on stderr and an exit code."""
    parser = argparse.ArgumentParser(
        program, description=HELP[program], formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    if program != "otr-tabulate":
        parser.add_argument(
            "-m", "--multirun", action="store_true", help="sweep over comma lists, range() and choice()"
        )
        parser.add_argument("--cfg", action="store_true", help="print the resolved configuration and stop")
    if program == "otr-plan":
        parser.add_argument(
            "--jobs", type=Path, metavar="FILE", help="also write one command a line, for xargs or sbatch --array"
        )
    arguments = parser.parse_intermixed_args()
    debug = "debug=true" in (word.lower() for word in arguments.overrides)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(EXIT_TERMINATED))  # so that workers are ended, too
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        _register_schemas()
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


def _run(arguments: argparse.Namespace) -> int:
    overrides = list(arguments.overrides)
    is_sweep, _ = _sweep_parameters(overrides, arguments.multirun)
    if arguments.cfg:
        print(OmegaConf.to_yaml(_compose("run", _expand(overrides, arguments.multirun)[0]), resolve=True))
        return 0
    if is_sweep:
        return _sweep(overrides)
    job = _job(_compose("run", overrides), overrides)
    check_tracking(job.config)
    try:
        run_job(job)
    except (PipelineError, BrokenPipeError):
        raise
    except Exception as error:
        print(f"traceback: {record_failure(job, error, _sweep_name())}", file=sys.stderr)
        raise
    return 0


def _sweep(overrides: list[str]) -> int:
    """Do every job of a sweep; failing ones do not stop the others and are named at the end."""
    words = _expand(overrides, multirun=True)
    if not words:
        raise ConfigError("these words make no job; look for an empty range()")
    jobs = _jobs(words)
    check_tracking(jobs[0].config)
    name = _sweep_name()
    own = [[word for word in job if not is_sweep_word(word) or word.startswith("launcher=")] for job in words]
    outcomes = run_sweep(jobs, lambda left: _launch(name, overrides, [jobs[i] for i in left], [own[i] for i in left]))
    failed = [outcome for outcome in outcomes if outcome.error]
    print(f"\n{len(outcomes)} jobs: {len(outcomes) - len(failed)} done, {len(failed)} failed")
    for outcome in failed:
        print(f"  {outcome.folder}: {outcome.error}")
        if outcome.traceback:
            print(f"    traceback: {outcome.traceback}")
    return EXIT_FAILED if failed else 0


def _launch(name: str, overrides: list[str], jobs: Sequence[Job], words: Sequence[list[str]]) -> list[Outcome]:
    """Do jobs, each with its own words, under the launcher that the overrides ask for; those of a fleet go together."""
    groups = fleets([job.config for job in jobs])
    carried = {variable: os.environ.get(variable) for variable in CARRIED_VARIABLES}
    task = _SweepTask(name, str(Path.cwd()), carried, [[words[i] for i in group] for group in groups])
    # Absolute, because Hydra makes this folder in whatever folder a launcher starts the job.
    sweep_dir = quoted(str(Path(jobs[0].config.results_dir).absolute() / "sweeps"))
    asked = [*overrides, "hydra.mode=MULTIRUN", f"hydra.sweep.dir={sweep_dir}"]
    with _hydra():
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        cfg = hydra.compose_config("run", asked, run_mode=RunMode.MULTIRUN)
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
        sweep: names the folder of the sweep's failures.
        cwd: where the command was given, which relative paths start from.
        environment: the variables there that settings depend on; None where one is not set.
        groups: the words of every job, group by group; a launcher is given the first of each.
    """

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
        jobs = _jobs(next(group for group in self.groups if group[0] == first))
        if HydraConfig.get().runtime.choices["hydra/launcher"] != "basic":
            jobs = [side_by_side(job) for job in jobs]
        return [self._outcome(job, error) for job, error in zip(jobs, run_jobs(jobs), strict=True)]

    def _outcome(self, job: Job, error: Exception | None) -> Outcome:
        if error is None:
            return Outcome(job.folder)
        path = record_failure(job, error, self.sweep)
        message = _message(error)
        if job.config.debug:
            traceback.print_exception(error)
        print(f"{job.folder} failed: {message}", file=sys.stderr, flush=True)
        return Outcome(job.folder, message.splitlines()[0], path)


def _plan(arguments: argparse.Namespace) -> int:
    words = _expand(list(arguments.overrides), arguments.multirun)
    jobs = _jobs(words)
    print_plan(jobs)
    if arguments.jobs:
        n_jobs = write_jobs(arguments.jobs, jobs, words)
        print(f"\n{how_to_use(arguments.jobs, n_jobs)}")
    return 0


def _tabulate(arguments: argparse.Namespace) -> int:
    cfg = _to_object(_compose("tabulate", list(arguments.overrides)))
    assert isinstance(cfg, TabulateConfig)
    results_dir = Path(cfg.results_dir)
    if not (results_dir / "runs").is_dir():
        raise ConfigError(f"results_dir={cfg.results_dir}: there is no folder {results_dir / 'runs'} with runs")
    different = 0
    if cfg.evaluate:
        for run_dir in sorted(path.parent for path in results_dir.glob("runs/**/summary.json")):
            different += replay(_load_config(run_dir, cfg.n_workers), run_dir)
    for path in write_table(cfg.table, results_dir):
        print(path)
        if path.suffix == ".md":
            print(f"\n{path.read_text(encoding='utf-8')}")
    return EXIT_FAILED if different else 0


def _jobs(words: Sequence[list[str]]) -> list[Job]:
    """Return the jobs with these overrides; those that differ in their seed alone are composed once."""
    composed: dict[tuple[str, ...], DictConfig] = {}
    jobs = []
    for job in words:
        seeds = [word for word in job if word.startswith("seed=")]
        rest = tuple(word for word in job if word not in seeds)
        if len(seeds) == 1 and rest in composed:
            composed[rest].seed = _parse(seeds[0]).value()
        else:
            composed[rest] = _compose("run", job)
        jobs.append(_job(composed[rest], job))
    return jobs


def _job(cfg: DictConfig, overrides: Sequence[str]) -> Job:
    config = _to_object(cfg)
    assert isinstance(config, RunConfig)
    named = [
        f"env={config.env.name}",
        f"method={config.method.name}",
        f"budget={config.budget.name}",
        f"trainer={config.trainer.name}",
    ]
    folder = run_folder(config, dataclasses.replace(_baseline(*named, f"depth={config.depth}"), seed=config.seed))
    words = [word for word in overrides if word.split("=")[0] not in ("stages", "hydra.mode")]
    return Job(
        config=dataclasses.replace(config, folder=folder),
        folder=folder,
        config_yaml=OmegaConf.to_yaml(cfg, resolve=True),
        command=shlex.join(["otr-run", *words]),
    )


@functools.cache
def _baseline(*words: str) -> RunConfig:
    """Return what these words give without any other override."""
    config = _to_object(_compose("run", words))
    assert isinstance(config, RunConfig)
    return config


def _load_config(run_dir: Path, n_workers: int | None) -> RunConfig:
    """Return the configuration that a finished run was made with."""
    try:
        cfg = OmegaConf.load(run_dir / "config.yaml")
        schema = _schema(RunConfig)
        schema.algo = _schema(schemas.ALGORITHMS[cfg.algo.name])
        if "trainer" in cfg:  # there was one trainer only before
            schema.trainer = _schema(schemas.FleetConfig if "n_envs" in cfg.trainer else schemas.TrainerConfig)
        loaded = _to_object(OmegaConf.merge(schema, cfg, {"n_workers": n_workers}))
    except (OSError, KeyError, OmegaConfBaseException, ConfigError) as error:
        raise corrupt(run_dir / "config.yaml", error) from error
    assert isinstance(loaded, RunConfig)
    return loaded


def _to_object(cfg: Any) -> Any:
    missing = OmegaConf.missing_keys(cfg)
    if missing:
        raise ConfigError(f"no value for {', '.join(sorted(missing))}")
    return OmegaConf.to_object(cfg)


def _expand(overrides: list[str], multirun: bool) -> list[list[str]]:
    """Return the overrides of every job that the words ask for, as Hydra's sweeper would make them."""
    is_sweep, parameters = _sweep_parameters(overrides, multirun)
    if not is_sweep:
        return [overrides]
    parsed = [_parse(word) for word in (*parameters, *overrides)]
    return [list(job) for job in BasicSweeper.split_arguments(parsed, None)[0]]


def _sweep_parameters(overrides: list[str], multirun: bool) -> tuple[bool, list[str]]:
    """Return whether the words ask for a sweep, and the sweep parameters that an experiment brings."""
    parsed = [_parse(word) for word in overrides]
    single = [word for word, override in zip(overrides, parsed, strict=True) if not override.is_sweep_override()]
    swept = [override.get_key_element() for override in parsed if override.is_sweep_override()]
    if swept and not multirun and not any(word.startswith("+experiment=") for word in overrides):
        raise ConfigError(f"{', '.join(swept)}: several values make a sweep; add -m")
    if any(key.lstrip("+") == "experiment" for key in swept):
        raise ConfigError("experiment: one at a time; start a command for each")
    experiments = [word for word in single if word.lstrip("+").startswith("experiment=")]
    if not experiments:
        return multirun, []
    for word in experiments:
        _check_option("experiment", word.split("=", 1)[1])
    with _hydra():
        # An environment is needed to compose at all; which one does not matter to hydra.sweeper.
        settings = compose("run", ["env=pendulum", *experiments], return_hydra_config=True).hydra
    parameters = [f"{key}={value}" for key, value in (settings.sweeper.params or {}).items()]
    return multirun or str(settings.mode).endswith("MULTIRUN"), parameters


def _parse(word: str) -> Override:
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException as error:
        raise ConfigError(f"{word} is no key=value: {str(error).splitlines()[0]}") from error


def _compose(name: str, overrides: Sequence[str]) -> DictConfig:
    """Return the composed configuration; unknown names come back with the nearest known ones."""
    for word in overrides:
        _parse(word)
        key, _, value = word.lstrip("+").partition("=")
        if word.startswith("+") and not key.startswith(("experiment", "env.kwargs.", "hydra.")):
            raise ConfigError(f"{word}: new keys cannot be added; leave out the +")
        if key in GROUPS and name == "run":
            _check_option(key, value)
        if key == "launcher":
            check_launcher(value)
    if name == "run" and not any(word.lstrip("+").startswith("env=") for word in overrides):
        raise ConfigError(f"which environment? Add env=NAME with one of: {', '.join(_options('env'))}")
    with _hydra():
        try:
            return compose(name, list(overrides))
        except HydraException as error:
            raise ConfigError(_explain(name, error, overrides)) from error


def _check_option(group: str, value: str) -> None:
    options = _options(group)
    if value not in (*options, "null"):
        raise ConfigError(f"{group}={value}: there is no such {group}.{_did_you_mean(value, options)}")


def _options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF_DIR / group).glob("*.yaml"))


def _explain(name: str, error: HydraException, overrides: Sequence[str]) -> str:
    """Return Hydra's message without its advice on `+`, with the nearest known key."""
    cause = error.__cause__
    lines = str(cause or error).splitlines()
    if "Could not override" in str(error):
        key = str(error).split("'")[1]
        base = [word for word in overrides if word.split("=")[0] in ("env", "algo", "trainer")]
        known = _leaves(OmegaConf.to_container(compose(name, base)))
        lines = [f"there is no key {key!r}.{_did_you_mean(key, known)}"]
    return _readable("\n".join(lines))


def _readable(message: str) -> str:
    """Return OmegaConf's message in one line that begins with the key."""
    lines = [line.strip() for line in message.splitlines() if line.strip() and "_type=" not in line]
    keys = [line.removeprefix("full_key: ") for line in lines if line.startswith("full_key: ")]
    rest = "\n".join(line for line in lines if not line.startswith("full_key: "))
    return f"{keys[0]}: {rest}" if keys else rest


def _leaves(value: Any, prefix: str = "") -> list[str]:
    if not isinstance(value, dict):
        return [prefix.rstrip(".")]
    return [prefix.rstrip(".")] * bool(prefix) + [
        leaf for key in value for leaf in _leaves(value[key], f"{prefix}{key}.")
    ]


def _did_you_mean(name: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    near += [key for key in known if key.split(".")[-1] == name and key not in near]
    return f" Did you mean {' or '.join(near)}?" if near else f" There are: {', '.join(known)}"


@contextmanager
def _hydra() -> Iterator[None]:
    """Make Hydra ready to compose from conf/, also inside a job that Hydra itself has started."""
    instance = GlobalHydra.instance()
    outer, instance.hydra = instance.hydra, None
    try:
        with initialize_config_dir(str(CONF_DIR.resolve()), job_name="otr", version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().hydra = outer


def _register_schemas() -> None:
    store = ConfigStore.instance()
    store.store("run_schema", _schema(RunConfig))
    store.store("tabulate_schema", _schema(TabulateConfig))
    store.store("env_schema", _schema(schemas.EnvConfig))
    store.store("method_schema", _schema(schemas.MethodConfig))
    store.store("budget_schema", _schema(schemas.BudgetConfig))
    for name, algorithm in schemas.ALGORITHMS.items():
        store.store(f"{name}_schema", _schema(algorithm), group="algo")
    for name, trainer in schemas.TRAINERS.items():
        store.store(f"{name}_schema", _schema(trainer), group="trainer")


def _schema(kind: type) -> DictConfig:
    """Return a dataclass as a schema to merge into: OmegaConf makes frozen ones read-only, which is undone here."""
    schema: DictConfig = OmegaConf.structured(kind)
    for node in (schema, *(schema._get_node(key) for key in schema)):
        if isinstance(node, DictConfig):
            OmegaConf.set_readonly(node, None)
    return schema


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
        return _readable(str(error))
    return str(error) if foreseen else f"{type(error).__name__}: {error}"
