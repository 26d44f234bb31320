"""`otr-verify`: a run's certificate, checked again."""

import argparse

from pipelines.cli.compose import Composer, to_object
from pipelines.cli.overrides import path_quoted
from pipelines.cli.runs import load_config
from pipelines.runs.export import find_run
from pipelines.runs.verify import VerifyConfig, verify_run

VERIFY = Composer("verify", {(None, "verify_schema"): VerifyConfig})


def do(arguments: argparse.Namespace) -> int:
    """Check a run's certificate and print what it says."""
    cfg: VerifyConfig = to_object(VERIFY.compose([path_quoted(override) for override in arguments.overrides]))
    folder = find_run(cfg.run, cfg.results_dir)
    print(verify_run(cfg, load_config(folder, None), folder))
    return 0
