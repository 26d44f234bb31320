"""`otr-export`: a policy as a program in another language."""

import argparse
import sys
from typing import Any

from pipelines.cli.overrides import without_environment
from pipelines.cli.runs import load_config, policy_of_model, written_policy
from pipelines.cli.settings import settings_of
from pipelines.runs.export import ExportConfig, check_export, policy_of, program_of, write_program
from pipelines.runs.finished_run import find_run


def do(arguments: argparse.Namespace) -> int:
    """Print the policy of a run, of a program file or of a model, or write it to a file."""
    overrides, of_env = without_environment(arguments)
    cfg: ExportConfig = settings_of(ExportConfig, overrides)
    check_export(cfg, of_env)
    policy: Any
    folder = None
    if cfg.program:
        run, policy = written_policy(str(cfg.env), cfg.program, of_env)
    elif cfg.model:
        run, policy = policy_of_model(str(cfg.env), cfg.model, of_env)
    else:
        folder = find_run(cfg.run, cfg.results_dir)
        run = load_config(folder, None)
        policy = policy_of(cfg, run, folder)
    program, proved = program_of(cfg, run, policy, folder)
    if proved:
        print(proved, file=sys.stderr)
    if cfg.out is not None:
        print(write_program(cfg, program))
    else:
        assert isinstance(program, str)
        sys.stdout.write(program)
    return 0
