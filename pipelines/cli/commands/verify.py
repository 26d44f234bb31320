"""`otr-verify`: what is proved of a policy."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import otr
from otr.clock import time_limit
from pipelines.cli.overrides import without_environment
from pipelines.cli.runs import load_config, written_policy
from pipelines.cli.settings import settings_of
from pipelines.config.run import RunConfig
from pipelines.engine.store import exists
from pipelines.engine.wrapping import columns, fitted
from pipelines.errors import ConfigError
from pipelines.runs.export import check_no_environment, check_policy
from pipelines.runs.finished_run import TREES, find_run, tree_of
from pipelines.runs.questions import Answer, always, ranges
from pipelines.runs.verify_run import VerifyConfig, certified_stage, compared, question_domain, verify_run
from pipelines.stages.parse import policy_tree, read_program


def do(arguments: argparse.Namespace) -> int:
    """Check a run's certificate, or answer a question about a policy, and print what is proved."""
    overrides, of_env = without_environment(arguments)
    cfg: VerifyConfig = settings_of(VerifyConfig, overrides)
    with time_limit(cfg.max_seconds, lambda: "what is asked was not answered"):
        if cfg.program is None and cfg.always is None and not cfg.range:
            if cfg.box is not None:
                raise ConfigError(
                    "box: a certificate is of the box that it was made for. Ask with always=CONDITION, range=true or "
                    "program=FILE, or make one of this box: otr-run ... certify=true box=..."
                )
            check_policy(cfg.run, None, cfg.env, of_env)
            folder = find_run(cfg.run, cfg.results_dir)
            print(fitted(verify_run(cfg, load_config(folder, None), folder), columns()))
            return 0
        try:
            answers = _answers(cfg, of_env)
        except (ValueError, otr.TreeTooLargeError) as error:  # the box is open, or the head, size or time refused
            raise ConfigError(str(error)) from error
    return 0 if all(answer.holds for answer in answers) else 1


def _own(form: str | None, run: RunConfig, folder: Path) -> tuple[Any, str]:
    """Return a run's policy that a program is compared with, its network where it has one, and what it is called."""
    if form is None and run.method.is_mapped:
        form = "polished_compact" if certified_stage(run, folder) == "polish" else "compact"
    own = tree_of(form or "pruned", run, folder)
    kind = "tree" if isinstance(own, otr.ObliqueTree) else "network"
    return own, f"the polished {kind}" if form in ("polished", "polished_compact") else f"the {kind}"


def _answers(cfg: VerifyConfig, of_env: Sequence[str]) -> list[Answer]:
    """Print the answers to what is asked of a run's policy, or of a program, and return them."""
    folder = find_run(cfg.run, cfg.results_dir) if cfg.run else None
    if folder is None:
        check_policy("", cfg.program, cfg.env, of_env)
        assert cfg.program is not None
        run, written = written_policy(str(cfg.env), cfg.program, of_env)
        program: otr.ObliqueTree | None = written
    else:
        check_no_environment(cfg.env, of_env)
        run = load_config(folder, None)
        program = policy_tree(read_program(cfg.program, run.env), run.env, cfg.program) if cfg.program else None
    answers, whose, other = list[Answer](), "", None
    if cfg.always is None and not cfg.range:
        if folder is not None and (cfg.tree is None or cfg.tree in TREES):
            other, what = _own(cfg.tree, run, folder)
        elif cfg.tree is not None:
            other, what = otr.load(Path(cfg.tree)), "the tree"
        else:
            raise ConfigError(
                f"program={cfg.program}: what is asked? Add run=FOLDER or tree=FILE to compare it, always=CONDITION or "
                "range=true"
            )
    elif program is None:
        assert folder is not None
        program = tree_of(cfg.tree or "pruned", run, folder)
        if not isinstance(program, otr.ObliqueTree):
            raise ConfigError(f"tree={cfg.tree}: it is not held as leaves, each of which is asked; use tree=pruned")
        whose = f"of the {(cfg.tree or 'pruned').replace('_', ' ')} tree, "
        if cfg.tree is None and exists(folder / "polish" / "report.json"):
            whose += "not of the polished one (tree=polished), "
    assert program is not None
    domain, where = question_domain(cfg.box, run, folder, program)
    if other is not None:
        other = other.network if isinstance(other, otr.PatternTree) else other
        answers.append(compared(program, other, run.env, domain, cfg.max_difference, what=what))
    if cfg.range:
        print("\n".join(ranges(program, run.env, domain)))
    if cfg.always is not None:
        answers.append(always(program, cfg.always, run.env, domain))
    for answer in answers:
        print(fitted(answer.text, columns()))
    how = ["; ranges to the rounding of a linear program"] if cfg.range and program.labels is None else []
    if cfg.always is not None and isinstance(program.head, otr.TanhBox):
        how.append("; conditions to 1e-6 under tanh")
    print(fitted(f"asked {whose}at every real point of {where}{''.join(how)}", columns()))
    return answers
