"""Which data sets there are, where their files come from, and what their content must be.

`files.csv` has a row for every file: its path in a data folder, its size, the hash that Git gives it as a blob and its
sha256, all of the unpacked content. PDBbind was never available: only the blob hash of its packed file is known.
"""

import csv
import hashlib
from dataclasses import dataclass
from importlib import resources
from typing import Literal

from pipelines.datasets.dataset import PARTS

# Lee & Jaakkola, "Oblique decision trees from derivatives of ReLU networks" (ICLR 2020): the splits. The commit first.
LCN_ROOTS = (
    "https://raw.githubusercontent.com/guanghelee/iclr20-lcn/78d2262207ef/data",
    "https://raw.githubusercontent.com/guanghelee/iclr20-lcn/master/data",
)
# RAND's Health Insurance Experiment, in the public domain, as Statsmodels 0.14.4 has it.
RANDHIE_ROOT = "https://raw.githubusercontent.com/statsmodels/statsmodels/v0.14.4/statsmodels/datasets/randhie"


@dataclass(frozen=True)
class DataFile:
    """A file and what its content must be."""

    path: str  # in a data folder, `lcn/...` or `raw/...`; there it may also be packed, with `.gz` after its name
    n_bytes: int | None  # size of the content; None where it is not known
    git_blob: str  # what `git hash-object` gives
    sha256: str | None  # in hex; None where it is not known

    @property
    def addresses(self) -> tuple[str, ...]:
        """Where the file can be fetched, the best first."""
        folder, _, rest = self.path.partition("/")
        return tuple(f"{root}/{rest}" for root in (LCN_ROOTS if folder == "lcn" else (RANDHIE_ROOT,)))

    @property
    def hashes(self) -> str:
        """The hashes as a message names them."""
        return f"Git blob hash {self.git_blob}" + (f", sha256 {self.sha256}" if self.sha256 else "")

    def difference(self, content: bytes) -> str | None:
        """Return what is wrong with this content, or None when it is the file's."""
        found = git_blob_hash(content)
        if found != self.git_blob:
            due = f" where {self.n_bytes:,} are due" if self.n_bytes not in (None, len(content)) else ""
            return f"{len(content):,} bytes{due}, Git blob hash {found} instead of {self.git_blob}"
        found = hashlib.sha256(content).hexdigest()
        if self.sha256 and found != self.sha256:
            return f"sha256 {found} instead of {self.sha256}"
        return None


@dataclass(frozen=True)
class MoleculeSet:
    """A classification data set of fingerprints."""

    name: str  # as `load_dataset` takes it
    lcn_name: str  # as LCN's repository writes it
    split_rule: Literal["scaffold", "random"]  # how LCN's parts come out of a file of SMILES

    @property
    def parts(self) -> dict[str, DataFile]:
        """The files of train, valid and test."""
        return {part: FILES[f"lcn/{self.lcn_name}_split/{part}.fgp2048.csv"] for part in PARTS}


def git_blob_hash(content: bytes) -> str:
    """Return the hash that Git names a file of this content by."""
    digest = hashlib.sha1(b"blob %d\0" % len(content), usedforsecurity=False)
    digest.update(content)
    return digest.hexdigest()


def _files() -> dict[str, DataFile]:
    text = resources.files("pipelines.datasets").joinpath("files.csv").read_text(encoding="utf-8")
    return {
        row["path"]: DataFile(row["path"], int(row["n_bytes"] or 0) or None, row["git_blob"], row["sha256"] or None)
        for row in csv.DictReader(text.splitlines())
    }


FILES = _files()
MOLECULES = {
    entry.name: entry
    for entry in (
        MoleculeSet("bace", "bace", "scaffold"),
        MoleculeSet("hiv", "HIV", "scaffold"),
        MoleculeSet("sider", "sider", "random"),
        MoleculeSet("tox21", "tox21", "random"),
    )
}
PDBBIND = FILES["lcn/PDBbind.pkl.gz"]
RANDHIE = FILES["raw/randhie.csv"]
EXAMPLES = ("breast_cancer", "digits", "diabetes")
NAMES = (*MOLECULES, "pdbbind", "randhie", *EXAMPLES)


def files_of(name: str) -> tuple[DataFile, ...]:
    """Return the files that a data set is read from; none for those that scikit-learn brings."""
    if name in MOLECULES:
        return tuple(MOLECULES[name].parts.values())
    return {"pdbbind": (PDBBIND,), "randhie": (RANDHIE,)}.get(name, ())
