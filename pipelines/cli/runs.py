"""The words of `otr-run`, `otr-plan` and the figures: from them to jobs."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pipelines import config as schemas
from pipelines.cli.compose import Composer, schema_of, to_object
from pipelines.cli.workflow import Workflow, command_of
from pipelines.config import METHODS, MethodConfig, RunConfig
from pipelines.config.run import run_folder
from pipelines.engine.store import corrupt
from pipelines.errors import ConfigError
from pipelines.stages.fleets import fleets
from pipelines.stages.parse import policy_tree
from pipelines.stages.run_job import RunJob, run_job, run_jobs
from pipelines.stages.shipped_programs import read_program
from pipelines.tracking.tracker import check_tracking

# The groups and keys that decide how an oracle is trained, and where and how that is done.
OF_TRAINING = ("env", "algo", "actor", "trainer", "budget", "train", "seed", "experiment", "results_dir", "n_workers",
               "side_by_side", "debug", "tracking")  # fmt: skip


def run_config(words: Sequence[str]) -> RunConfig:
    """Return the configuration of `otr-run` with these words."""
    return _run_config(tuple(words))


def load_config(run_dir: Path, n_workers: int | None) -> RunConfig:
    """Return the configuration that a finished run was made with."""
    try:
        cfg = OmegaConf.load(run_dir / "config.yaml")
        schema = schema_of(RunConfig)
        schema.algo = schema_of(schemas.ALGORITHMS[cfg.algo.name])
        schema.method = schema_of(METHODS[cfg.method.name])
        if "trainer" in cfg:  # there was one trainer only before
            cfg.trainer.pop("device", None)  # fleets had one, which decided nothing
            schema.trainer = schema_of(schemas.FleetConfig if "n_envs" in cfg.trainer else schemas.TrainerConfig)
        loaded = to_object(OmegaConf.merge(schema, cfg, {"n_workers": n_workers}))
    except (OSError, KeyError, OmegaConfBaseException, ConfigError) as error:
        raise corrupt(run_dir / "config.yaml", error) from error
    assert isinstance(loaded, RunConfig)
    return loaded


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
    oracle = _oracle_job(config, overrides) if config.method.imitates else None
    config = dataclasses.replace(config, oracle_run=oracle.config if oracle else None)
    folder = run_folder(config, dataclasses.replace(baseline, seed=config.seed))
    return RunJob(
        config=dataclasses.replace(config, folder=folder),
        folder=folder,
        config_yaml=OmegaConf.to_yaml(cfg, resolve=True),
        command=command_of("otr-run", overrides),
        oracle=oracle,
    )


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
    """Return the overrides that the choice of the method and the algorithm implies."""
    given = dict(word.split("=", 1) for word in overrides if "=" in word)
    return METHODS.get(given.get("method", "otr"), MethodConfig).implied(given)


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
    RUN.composer.register()
    config = to_object(RUN.composer.compose(words))
    assert isinstance(config, RunConfig)
    return config


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
            **{("method", f"run_{name}_schema"): method for name, method in METHODS.items()},
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
