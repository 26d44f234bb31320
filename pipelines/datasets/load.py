"""`load_dataset`: the data sets of the catalogue."""

import numpy as np

from pipelines.datasets.catalogue import EXAMPLES, MOLECULES, NAMES, MoleculeSet
from pipelines.datasets.dataset import Dataset, Part
from pipelines.datasets.download import locate, read
from pipelines.datasets.examples import load_example
from pipelines.datasets.molecules import FEATURE_NAMES, parse_split
from pipelines.datasets.pdbbind import load_pdbbind
from pipelines.datasets.randhie import load_randhie
from pipelines.datasets.splits import scaffolds_by_part, shuffled_scaffold_split
from pipelines.errors import ConfigError, MissingInputError, did_you_mean

OWN_FORM = {"pdbbind": load_pdbbind, "randhie": load_randhie}  # files that are no fingerprints


def load_dataset(name: str, split: int | None = None) -> Dataset:
    """Return a data set of NAMES, fetching it where it is not on this machine yet.

    Args:
        name: of the data set.
        split: of molecules, the seed that redraws the parts, whole scaffolds together (`shuffled_scaffold_split`);
            None for the parts as published.

    Raises:
        ConfigError: there is no such data set, or its rows have no scaffolds to split them by.
        MissingInputError: it is not here and could not be had; names addresses, hashes and where to put it.
        PipelineError: a local file is damaged.
    """
    check_name(name)
    check_split(name, split)
    if name in EXAMPLES:
        return load_example(name)
    if name in OWN_FORM:
        return OWN_FORM[name]()
    dataset = _load_molecules(MOLECULES[name])
    if split is None:
        return dataset
    scaffolds = np.concatenate([*scaffolds_by_part(MOLECULES[name]).values()])
    return dataset.with_parts(shuffled_scaffold_split(scaffolds, split))


def check_name(name: str) -> None:
    """Raise a ConfigError with the nearest known name if there is no such data set."""
    if name not in NAMES:
        raise ConfigError(f"there is no data set {name!r}.{did_you_mean(name, NAMES)}")


def check_split(name: str, split: int | None) -> None:
    """Raise a ConfigError where a data set that has no scaffolds is to be split by them."""
    if split is not None and name not in MOLECULES:
        raise ConfigError(f"{name} has no scaffolds to split it by; those with scaffolds are {', '.join(MOLECULES)}")


def _load_molecules(entry: MoleculeSet) -> Dataset:
    parts, label_names, scaffolds = {}, {}, scaffolds_by_part(entry)
    for part, content in _contents(entry).items():
        label_names[part], X, Y = parse_split(content)
        parts[part] = Part(X, Y, scaffolds[part])
    return Dataset(entry.name, "classification", label_names["train"], FEATURE_NAMES, *parts.values())


def _contents(entry: MoleculeSet) -> dict[str, bytes]:
    try:
        return {part: read(file) for part, file in entry.parts.items()}
    except MissingInputError as error:
        missing = [file for file in entry.parts.values() if locate(file) is None]
        others = "".join(f"\nLikewise missing: {file.path} ({file.hashes})" for file in missing[1:])
        raise MissingInputError(f"{error}{others}") from error
