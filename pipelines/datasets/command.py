"""The command `otr-data`: fetches data sets, compares them with their hashes and says what is there."""

import argparse
import sys
from collections.abc import Sequence
from importlib.metadata import version

import numpy as np
from rich.console import Console
from rich.table import Table

from pipelines.datasets.catalogue import EXAMPLES, MOLECULES, NAMES, files_of
from pipelines.datasets.dataset import PARTS, Dataset
from pipelines.datasets.download import given_folder, locate, own_folder
from pipelines.datasets.load import check_name, load_dataset
from pipelines.engine.wrapping import columns, fitted
from pipelines.errors import ConfigError, PipelineError

EXIT_FAILED, EXIT_USAGE = 1, 2
HELP = """\
Fetch the data sets of Table 4.2 and one of counts, compare every file with its hash, and print what is there. What is
there already is read and compared again; nothing is fetched twice.

names:
  bace hiv sider tox21          fingerprints of molecules with the splits of LCN (Lee & Jaakkola, ICLR 2020)
  pdbbind                       protein-ligand affinities, regression
  randhie                       counts of visits to a doctor, for the Poisson loss
  breast_cancer digits diabetes come with scikit-learn, nothing to fetch"""
EPILOG = """\
where files are:
  $XDG_DATA_HOME/otr, or ~/.local/share/otr. OTR_DATA_DIR=FOLDER reads FOLDER/lcn/bace_split/train.fgp2048.csv (or
  .csv.gz) and so on instead, and fetches nothing.

examples:
  otr-data bace hiv sider tox21 pdbbind
  otr-data --list
  OTR_DATA_DIR=iclr20-lcn/data otr-data bace"""


def main(given: Sequence[str]) -> int:
    """Do what the arguments ask for and return the exit code; one data set's failure does not stop the others."""
    parser = argparse.ArgumentParser(
        "otr-data", description=HELP, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"otr-data {version('otr')}")
    parser.add_argument("names", nargs="*", metavar="NAME", help="data sets, as above")
    parser.add_argument("--list", action="store_true", help="say which data sets are there; fetch nothing")
    arguments = parser.parse_args(given)
    if not arguments.names and not arguments.list:
        parser.error(f"name data sets ({' '.join(NAMES)}) or give --list")
    try:
        for name in arguments.names:
            check_name(name)
        if arguments.list:
            _list(arguments.names or NAMES)
            return 0
        return _fetch(arguments.names)
    except ConfigError as error:
        print(f"otr-data: {error}", file=sys.stderr)
        return EXIT_USAGE


def _fetch(names: Sequence[str]) -> int:
    table = Table(caption="train/valid/test; shares are of the measured labels", caption_justify="left")
    for heading in ("data set", "rows", "labels", "share of ones", "hash"):
        table.add_column(heading, justify="left" if heading in ("data set", "hash") else "right", no_wrap=True)
    places, failures = [], []
    for name in dict.fromkeys(names):
        try:
            dataset = load_dataset(name)
        except PipelineError as error:
            failures.append(f"{name}: {error}")
            continue
        rows = "/".join(f"{len(dataset.part(part).X):,}" for part in PARTS)
        table.add_row(name, rows, str(len(dataset.label_names)), _shares(dataset), "" if name in EXAMPLES else "ok")
        places.append(f"{name}: {_place(name)}")
    if places:
        Console(highlight=False, width=columns()).print(table)
        print(fitted("\n".join(places), columns()))
    for failure in failures:
        print(f"otr-data: {failure}", file=sys.stderr)
    return EXIT_FAILED if failures else 0


def _list(names: Sequence[str]) -> None:
    print(f"data folder: {given_folder() or own_folder()}")
    for name in names:
        n_there = sum(locate(file) is not None for file in files_of(name))
        n_files = len(files_of(name))
        print(f"  {name:<14} {_place(name) if n_there == n_files else f'{n_there} of {n_files} files here'}")


def _place(name: str) -> str:
    """Return the folders or the file that a data set is read from."""
    if name in EXAMPLES:
        return "comes with scikit-learn"
    paths = [path for path in map(locate, files_of(name)) if path]
    return ", ".join(dict.fromkeys(str(path.parent if name in MOLECULES else path) for path in paths))


def _shares(dataset: Dataset) -> str:
    """Return the share of ones among the measured labels of each part, where labels are 0 and 1."""
    labels = [dataset.part(part).Y for part in PARTS]
    if dataset.task != "classification" or max(np.nanmax(Y) for Y in labels) > 1:
        return ""
    return "/".join(f"{np.nanmean(Y):.4f}".lstrip("0") for Y in labels)
