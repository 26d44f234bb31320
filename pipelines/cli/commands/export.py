"""`otr-export`: a run's policy as a program."""

import argparse
import sys

from pipelines.cli.compose import Composer, to_object
from pipelines.cli.overrides import path_quoted
from pipelines.cli.runs import load_config
from pipelines.runs.export import ExportConfig, check_export, find_run, program_of, write_program

EXPORT = Composer("export", {(None, "export_schema"): ExportConfig})


def do(arguments: argparse.Namespace) -> int:
    """Print a run's policy as a program, or write it to a file."""
    cfg: ExportConfig = to_object(EXPORT.compose([path_quoted(override) for override in arguments.overrides]))
    check_export(cfg)
    folder = find_run(cfg.run, cfg.results_dir)
    program = program_of(cfg, load_config(folder, None), folder)
    if cfg.out is not None:
        print(write_program(cfg, program))
    else:
        assert isinstance(program, str)
        sys.stdout.write(program)
    return 0
