"""The overrides of `otr-run`, `otr-plan` and the figures: from them to jobs."""

import dataclasses
import functools
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import otr
from otr.core.smooth_network import Layered
from pipelines.cli.compose import schema_of, to_object
from pipelines.cli.overrides import key_of, parse, quoted
from pipelines.cli.short_forms import SHORT, imitates, imitating, spelt_out
from pipelines.cli.workflow import Workflow
from pipelines.config.algo import ALGORITHMS, ArsConfig, is_small
from pipelines.config.budget import BudgetConfig
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.env import EnvConfig
from pipelines.config.methods import METHODS, AugTreeConfig, ProgramConfig, TakesModel
from pipelines.config.model import ImportedModel
from pipelines.config.recipe import OF_TRAINING, TRAINED_BY, always_implied, recipe, remaining
from pipelines.config.run import RunConfig, changes_text, run_folder
from pipelines.config.setting import declared, not_keyed
from pipelines.config.trainer import SHRINK, TRAINERS, FleetConfig, TrainerConfig
from pipelines.engine.job import Job
from pipelines.engine.store import CONFIG, corrupt, read_bytes
from pipelines.errors import ConfigError, did_you_mean
from pipelines.play.boxes import given_box
from pipelines.play.environments import episode_limit, is_discrete, make_env, registered_ids
from pipelines.play.own_environment import check_environment, own_environment
from pipelines.play.video import check_video
from pipelines.runs.fleets import fleets
from pipelines.runs.imitation import OTHERS, imitating_command
from pipelines.runs.result import result_row
from pipelines.runs.run_job import RunJob, run_job, run_jobs
from pipelines.runs.stage_table import STAGES
from pipelines.stages.import_model import read_model
from pipelines.stages.parse import policy_tree, read_program
from pipelines.stages.polish import POLISH, check_polish
from pipelines.tracking.tracker import check_tracking

# The groups and keys that decide how an oracle is trained, and where and how that is done.
OF_ORACLES = (
    *OF_TRAINING,
    "env",
    "budget",
    "experiment",
    "results_dir",
    "n_workers",
    "side_by_side",
    "debug",
    "tracking",
)

# Settings that further stages alone read, and these
SETTINGS_OF = {
    name: {stage.name for stage in STAGES.values() if stage.settings and name in declared(stage.settings)}
    for name in ("polishing", "certification", "simplification")
}
OF_THE_FILE = ("method.model", "method.normalise", "method.output")
# Settings of finished runs that no longer exist, and the value that means what is done now; others are refused
REMOVED = {
    "mp4": False,
    "trainer.environments": "gymnasium",
    "trainer.precision": "fp32",
    "algo.critic_norm": "none",
    "algo.critic_learning_rate": None,
    "algo.actor_value": "min",
    "polishing.critic.actor_value": "min",
}


def _of_task(table: DictConfig, task: str, *names: str) -> Any:
    """Return a task's row of a budget's table, or a number of it; that of `others` where the table has no such task."""
    return functools.reduce(lambda found, name: found[name], names, table.get(task, table.get("others")))


OmegaConf.register_new_resolver("of_task", _of_task, replace=True)
# For recipes: their settings of small actors do not apply to oracles, nor to the linear policy.
OmegaConf.register_new_resolver("dense_if_small", lambda depth: "input" if is_small(depth) else "none", replace=True)


def run_config(overrides: Sequence[str]) -> RunConfig:
    """Return the configuration of `otr-run` with these overrides."""
    config: RunConfig = to_object(RUN.compose(overrides))
    return config


def load_config(run_dir: Path, n_workers: int | None) -> RunConfig:
    """Return the configuration that a finished run was made with."""
    try:
        cfg = DictConfig(OmegaConf.create(read_bytes(run_dir / CONFIG).decode()))
        for name, value in REMOVED.items():
            parent, _, key = name.rpartition(".")
            place = OmegaConf.select(cfg, parent) if parent else cfg
            if isinstance(place, DictConfig) and place.get(key) == value:
                place.pop(key, None)
        if "vec_normalize" in cfg.method:  # as it was called before other statistics were taken
            cfg.method.normalise = cfg.method.pop("vec_normalize")
        schema = schema_of(RunConfig)
        schema.algo = schema_of(ALGORITHMS[cfg.algo.name])
        schema.method = schema_of(METHODS[cfg.method.name])
        if isinstance(cfg.get("trainer"), DictConfig):  # there used to be a single trainer
            schema.trainer = schema_of(FleetConfig if "n_envs" in cfg.trainer else TrainerConfig)
        loaded = to_object(OmegaConf.merge(schema, cfg, {"n_workers": n_workers}))
    except (OSError, KeyError, UnicodeDecodeError, yaml.YAMLError, OmegaConfBaseException, ConfigError) as error:
        raise corrupt(run_dir / CONFIG, error) from error
    assert isinstance(loaded, RunConfig)
    return loaded


def written_policy(env: str, program: str, of_env: Sequence[str] = ()) -> tuple[RunConfig, otr.ObliqueTree]:
    """Return the run that would play a program file, or a shipped program, and the policy that it says.

    `of_env` are further overrides of the environment, such as its names.
    """
    (job,) = RUN.jobs([RUN.spelt_out([f"env={env}", *of_env, f"program={quoted(program)}"])])
    config = job.config
    return config, policy_tree(config.program_text, config.env, program)


def policy_of_model(env: str, model: str, of_env: Sequence[str] = ()) -> tuple[RunConfig, Layered]:
    """Return the run that would play a model's policy, which need not have a tree, and that network."""
    (job,) = RUN.jobs([RUN.spelt_out([f"env={env}", *of_env, f"model={quoted(model)}", "stages=[import]"])])
    policy = job.config.imported.policy
    if not isinstance(policy, Layered):
        raise ConfigError(f"model={model}: {policy.reason}, so it is no network that a program could hold")
    return job.config, policy


def _check_later_stages(config: RunConfig) -> None:
    """Raise ConfigError where a later stage, or tracking, lacks a package or cannot be done."""
    if config.method.continuous_only and is_discrete(make_env(config.env)):
        raise ConfigError(
            f"method={config.method.name} has continuous actions, but those of {config.env.id} are labels"
        )
    check_tracking(config)
    check_video(config)
    if "polish" in config.selected_stages:
        check_polish(POLISH.of(config))


class RunWorkflow(Workflow):
    """`otr-run`, whose jobs are runs."""

    needs = ("env", "environment")
    besides = "; besides, any registered id, as CartPole-v1 or my_module:Maze-v0"
    anything = "pendulum"
    short = SHORT
    decisive = ("env.", "depth")  # an environment without a file is made, to be asked; a recipe may be of one depth
    naming = ("env", "method", "budget", "depth", "seed")
    harmless = not_keyed(RunConfig)
    do = staticmethod(run_job)
    do_group = staticmethod(run_jobs)
    groups = staticmethod(fleets)
    row = staticmethod(result_row)
    check = staticmethod(_check_later_stages)

    def implied(self, overrides: Sequence[str]) -> list[str]:
        """Return the overrides that the choice of budget, method, environment and algorithm implies."""
        given = _by_key(overrides)
        words = remaining(recipe(given), given)
        return [*words, *always_implied(given | _by_key(words))]

    def check_option(self, group: str, value: str) -> None:
        """Take any environment that is registered with gymnasium, besides those that have a file."""
        known = self.options(group)
        if group != "env" or value in known:
            super().check_option(group, value)
        elif ":" not in value and value not in registered_ids():
            hint = did_you_mean(value, known, unlisted=registered_ids())
            more = "" if "?" in hint else "; besides, any registered id, as CartPole-v1"
            if re.search(r"-v\d+$", value):
                more += (
                    f"{' ' if hint.endswith('?') else '. '}Where a module of yours registers it: env=my_module:{value}"
                )
            raise ConfigError(f"env={value}: there is no such environment.{hint}{more}")

    def _compose_exactly(self, overrides: Sequence[str]) -> DictConfig:
        """Compose, with an environment's own settings of direct search in place of the general ones."""
        env = next((override for override in reversed(overrides) if override.startswith("env=")), "").partition("=")[2]
        if env and env not in self.options("env"):
            self.check_option("env", env)
            _offer(own_environment(env, _env_kwargs(overrides)))
        own = f"ars_{env}"
        if (CONF_DIR / "algo" / f"{own}.yaml").is_file():
            overrides = [f"algo={own}" if override == "algo=ars" else override for override in overrides]
        return super()._compose_exactly(overrides)

    def spelt_out(self, overrides: Sequence[str]) -> list[str]:
        """Return overrides with those replaced that are short for others, after those of the recipe `default`.

        That is for commands that name neither a method nor who trains, and it may name both.
        """
        words = spelt_out(overrides)
        given = _by_key(words)
        if not given.keys().isdisjoint(("method", "experiment", *TRAINED_BY)):
            return words
        return [*remaining(recipe(given, "default"), given), *words]

    def expand(self, overrides: Sequence[str], multirun: bool) -> list[list[str]]:
        """Return the overrides of every job; refuse settings of imitation or training where no job does that."""
        jobs = super().expand(overrides, multirun)
        words = [override for own in jobs for override in own]
        vain = [override for override in words if key_of(override) == "oracle" or override.startswith("imitate.")]
        if vain and not any(imitates(override) or key_of(override) == "experiment" for override in words):
            raise ConfigError(f"{vain[0]}: nothing is imitated. Add {imitating()}, or leave {vain[0]} out")
        for own in jobs:
            policies = [override for override in own if key_of(override) in ("method.model", "method.program")]
            vain = [override for override in own if key_of(override).partition(".")[0] in OF_TRAINING]
            if policies and vain:
                policy = policies[0].removeprefix("method.")
                raise ConfigError(f"{vain[0]}: nothing is trained, as {policy} is there already; leave {vain[0]} out")
        return jobs

    def jobs(self, overrides_of_jobs: Sequence[Sequence[str]]) -> list[Job]:
        """Return the jobs; report settings that none of their stages reads, and jobs that a fleet does not train."""
        jobs = super().jobs(overrides_of_jobs)
        for settings, stages in SETTINGS_OF.items():
            given = [(job, word) for job in jobs for word in job.overrides if word.startswith(f"{settings}.")]
            if given and all(stages.isdisjoint(job.config.selected_stages) for job, _ in given):
                word = given[0][1]
                asked = " or ".join(f"{stage}=true" for stage in sorted(stages))
                print(f"{word} names the run's folder, and nothing else: add {asked}", file=sys.stderr, flush=True)
        trained = [job.config.oracle_run or job.config for job in jobs if "trainer=fleet" in job.overrides]
        others = [config for config in trained if config.trainer_name not in ("fleet", "none")]
        if others:
            env, algo, n = others[0].env.name, others[0].algo.name, len(others)
            who = "by direct search" if isinstance(others[0].algo, ArsConfig) else "by Stable-Baselines3"
            more = f"; {n} of {len(jobs)} jobs are trained without the fleet" if n > 1 else ""
            note = f"trainer=fleet trains SAC alone: env={env} is trained {who} with algo={algo}{more}"
            print(note, file=sys.stderr, flush=True)
        imported = [job.config.imported for job in jobs if job.config.imported is not None]
        for note in dict.fromkeys(model.note for model in imported if model.note):
            print(note, file=sys.stderr, flush=True)
        return jobs

    def job(self, overrides: Sequence[str]) -> RunJob:
        """Return the run with these overrides, and the run that trains its oracle."""
        words = list(overrides)
        made = self.composed(words)
        config: RunConfig = made.config
        if config.env.name not in self.options("env") or any(key_of(each)[:4] == "env." for each in overrides):
            check_environment(config.env)
            episode_limit(config.env)  # refuses an environment without one, before anything runs
        if config.certification.box is not None:
            given_box(config.env, config.certification.box)  # refuses sides that are of no state
        if isinstance(config.method, ProgramConfig):
            text, depth = _program(config, config.method.program, overrides)
            words.append(f"depth={depth}")
            made = self.composed(words)
            config = dataclasses.replace(made.config, program_text=text)
        elif isinstance(config.method, TakesModel) and (
            config.method.model or config.method.normalise or config.method.output or config.method.name == "model"
        ):
            imported, widths = _model(config, overrides)
            words.append(f"{'oracle' if config.method.imitates else 'depth'}={widths}")
            made = self.composed(words)
            config = dataclasses.replace(made.config, imported=imported)
        oracle = self.job(_of_oracle(config, overrides)) if config.method.imitates else None
        differences = self.differences(config, words, _named(config, overrides))
        if config.imported is not None:
            differences.pop("trainer", None)  # any trainer may have trained it
        if isinstance(config.trainer, FleetConfig) and not config.fleet:  # which trains SAC alone: without effect
            config = dataclasses.replace(config, trainer=TrainerConfig("sb3"))
        folder = run_folder(config, differences)
        config = dataclasses.replace(
            config,
            folder=folder,
            changes=changes_text(config, differences),
            oracle_run=oracle.config if oracle else None,
        )
        return RunJob(config, folder, made.yaml, tuple(overrides), oracle)


def _by_key(overrides: Sequence[str]) -> dict[str, str]:
    """Return the values of overrides by key."""
    return {key_of(override): override.partition("=")[2] for override in overrides}


def _algorithm_of(env: str) -> str | None:
    """Return the algorithm that the file of an environment, or one that it builds on, chooses; None without a file."""
    file = CONF_DIR / "env" / f"{env}.yaml"
    found = None
    for entry in yaml.safe_load(file.read_text(encoding="utf-8"))["defaults"] if file.is_file() else ():
        found = (_algorithm_of(entry) if isinstance(entry, str) else entry.get("override /algo")) or found
    return found


def _offer(env: EnvConfig) -> None:
    """Make an environment that has no file an option of Hydra's group env: PPO for labels, SAC for other actions."""
    *folders, option = f"env/{env.id}".split("/")
    algorithm = {"discrete": "ppo", "continuous": "sac"}[env.task]
    node = {
        "defaults": ["/env_schema@env", {"override /algo": algorithm}, "_self_"],
        "env": {name: value for name, value in dataclasses.asdict(env).items() if name not in ("kwargs", "pid")},
    }
    ConfigStore.instance().store(option, node, group="/".join(folders), package="_global_")


def _env_kwargs(overrides: Sequence[str]) -> dict[str, Any]:
    """Return the arguments of the environment among overrides."""
    given = (override for override in overrides if key_of(override).startswith("env.kwargs."))
    return {key_of(override).removeprefix("env.kwargs."): parse(override).value() for override in given}


def _named(config: RunConfig, overrides: Sequence[str]) -> list[str]:
    """Return the algorithms and trainers that a run's folder names: who trains, and what would train it by default.

    A trainer that does not train the run is named as Stable-Baselines3, which trains it, unless the recipe has that.
    """
    given, others = _by_key(overrides), [override for override in overrides if not override.startswith("algo=")]
    named = ["trainer=sb3", "algo=ars" if isinstance(config.algo, ArsConfig) else "algo=sac" if config.fleet else ""]
    if "algo" in given:
        implied = (override for override in RUN.implied(others) if key_of(override) == "algo")
        named.append([f"algo={_algorithm_of(given['env'])}", *implied][-1])
    if "trainer" in given and (config.fleet is not None or "trainer=sb3" not in recipe(given)):
        named.append(f"trainer={given['trainer']}")
    return named


def _program(config: RunConfig, program: str, overrides: Sequence[str]) -> tuple[str, int]:
    """Return a program's text and the depth of its tree."""
    text = read_program(program, config.env)
    given = [override for override in overrides if override.startswith("depth=")]
    if given:
        raise ConfigError(f"{given[0]}: the depth of a program's tree is its own; leave {given[0]} out")
    return text, policy_tree(text, config.env, program).depth


def _model(config: RunConfig, overrides: Sequence[str]) -> tuple[ImportedModel, str]:
    """Return the policy that a run takes from a file, and its hidden widths as the value of an override.

    Raises:
        ConfigError: no policy can be read from it, or the run asks for its tree and it has none; says how to make one.
    """
    method = config.method
    assert isinstance(method, TakesModel)
    if not method.model:
        raise ConfigError(f"method={method.name}: which model? Add model=FILE")
    name = "oracle" if method.imitates else "model"
    imported = read_model(method.model, method.normalise, config.env, name, method.output)
    key, given = ("oracle", "oracle=[") if method.imitates else ("depth", "depth=")
    for override in overrides:
        if override.startswith(given):
            raise ConfigError(f"{override}: {key} is the model's own; leave {override} out")
    if method.imitates and not imported.policy.hidden_widths:
        raise ConfigError(
            f"oracle={method.model} is linear, which is a tree of one leaf as it is; add model={method.model} in place "
            f"of oracle and method={method.name}"
        )
    if isinstance(imported.policy, otr.ReluNetwork):
        pass
    elif isinstance(method, AugTreeConfig) and method.features == "deep":
        raise ConfigError(
            f"method.features=deep reads activation patterns, which {method.model} has none of "
            f"({imported.policy.reason}); leave it out"
        )
    elif "map" in config.selected_stages and not method.imitates:
        raise ConfigError(
            f"model={method.model}: {imported.policy.reason.partition(';')[0]}, and no tree is equal to it. Of the "
            f"methods that imitate it, {OTHERS}; augtree makes a tree:\n  {imitating_command(config, overrides)}"
        )
    return imported, f"[{','.join(map(str, imported.policy.hidden_widths))}]".replace("[]", "0")


def _of_oracle(config: RunConfig, overrides: Sequence[str]) -> list[str]:
    """Return the overrides of the run that trains an oracle: the oracle's layers are the depth of method=otr.

    Its trainer, or the search, is the imitating run's, which may be a recipe's. An oracle from a file is
    imported by method=model.
    """
    own = [override for override in overrides if key_of(override).split(".")[0] in OF_ORACLES]
    if config.trainer.name == SHRINK:  # which a fleet's oracle is for
        own = [override for override in own if key_of(override) not in ("trainer", "train.steps")]
        own += ["trainer=fleet", f"train.steps={config.train.steps}"]
    if config.imported is not None:
        files = [override for override in overrides if key_of(override) in OF_THE_FILE]
        return [*own, "method=model", *files, "stages=[import]", f"seed={config.seed}"]
    if not any(key_of(override) == "trainer" for override in own):
        own.append(f"trainer={config.trainer.name}")
    own += [override for override in RUN.implied(overrides) if key_of(override) == "algo"]
    depth = f"depth={config.oracle}".replace(" ", "")
    return [*own, depth, "method=otr", "stages=[train]", f"seed={config.seed}"]


RUN = RunWorkflow(
    "run",
    {
        (None, "run_schema"): RunConfig,
        (None, "env_schema"): EnvConfig,
        **{("method", f"run_{name}_schema"): method for name, method in METHODS.items()},
        (None, "budget_schema"): BudgetConfig,
        **{("algo", f"{name}_schema"): algorithm for name, algorithm in ALGORITHMS.items()},
        **{("trainer", f"{name}_schema"): trainer for name, trainer in TRAINERS.items()},
    },
    checked=("env", "algo", "method", "trainer", "budget", "launcher", "experiment"),
)
