"""`otr-fit`: do fits."""

import argparse

from pipelines.cli.commands.run import do_jobs
from pipelines.cli.fits import FIT


def do(arguments: argparse.Namespace) -> int:
    """Do the fits that the overrides ask for."""
    return do_jobs(FIT, arguments)
