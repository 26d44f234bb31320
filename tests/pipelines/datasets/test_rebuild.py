"""Split files from SMILES: byte for byte LCN's with RDKit, and what is said without it."""

import shutil

import numpy as np
import pytest

from pipelines.datasets import load, load_dataset, rebuild
from pipelines.datasets.catalogue import MOLECULES
from pipelines.datasets.scaffolds import number_scaffolds, scaffolds_of
from pipelines.errors import PipelineError

from .conftest import expect, split_file


def test_without_rdkit_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(rebuild, "can_rebuild", lambda: False)
    with pytest.raises(PipelineError, match=r"rebuilding bace needs RDKit: pip install 'otr\[molecules\]'"):
        rebuild.rebuild(MOLECULES["bace"])


def test_the_bits_of_old_rows_are_at_hand():
    assert {name: len(rebuild._old_rows(name)) for name in ("bace", "HIV", "sider", "tox21")} == {
        "bace": 0,
        "HIV": 74,
        "sider": 0,
        "tox21": 3,
    }


def test_what_cannot_be_fetched_is_rebuilt_and_kept(server, tiny_bace, own, monkeypatch, capsys):
    contents = {part: tiny_bace[file.path] for part, file in MOLECULES["bace"].parts.items()}
    monkeypatch.setattr(load, "can_rebuild", lambda: True)
    monkeypatch.setattr(load, "rebuild", lambda entry: contents)
    assert load_dataset("bace").train.Y.tolist() == [[1], [0]]
    assert "404" in capsys.readouterr().err
    asked = len(server.asked)
    load_dataset("bace")  # now from the user's folder
    assert len(server.asked) == asked
    assert len(list((own / "lcn" / "bace_split").glob("*.gz"))) == 3


def test_a_rebuild_that_fails_is_told_with_the_download(server, monkeypatch):
    def fail(entry):
        raise PipelineError("no SMILES")

    monkeypatch.setattr(load, "can_rebuild", lambda: True)
    monkeypatch.setattr(load, "rebuild", fail)
    with pytest.raises(PipelineError, match=r"(?s)404.*Nor can they be made from SMILES: no SMILES"):
        load_dataset("bace")


def test_another_fingerprint_is_not_passed_off_as_lcns(rdkit_at_hand, own, monkeypatch):
    raw = b"mol,Class\nCCO,1\nc1ccccc1,0\n"
    expect(monkeypatch, "raw/bace.csv", raw)
    for part in ("train", "valid", "test"):
        expect(monkeypatch, f"lcn/bace_split/{part}.fgp2048.csv", split_file("Class", (1, "1")))
    (own / "raw").mkdir(parents=True)
    (own / "raw" / "bace.csv").write_bytes(raw)
    with pytest.raises(PipelineError, match=r"as RDKit .* gives it is not LCN's"):
        rebuild.rebuild(MOLECULES["bace"])


@pytest.mark.slow
@pytest.mark.parametrize("name", MOLECULES)
def test_rebuilt_files_are_lcns(rdkit_at_hand, real_data, own, monkeypatch, name):
    raw = real_data / "raw"
    if not raw.is_dir():
        pytest.skip(f"{real_data} has no raw/ with SMILES")
    monkeypatch.delenv("OTR_DATA_DIR")
    own.mkdir(parents=True)
    shutil.copytree(raw, own / "raw", ignore=lambda *_: ["pdbbind"])
    contents = load.rebuild_and_keep(MOLECULES[name])  # compares hashes itself
    for part, file in MOLECULES[name].parts.items():
        assert file.difference(contents[part]) is None
    np.testing.assert_array_equal(number_scaffolds(MOLECULES[name]), scaffolds_of(name))  # the file in the package
    assert len(load_dataset(name).test.X) == {"bace": 152, "hiv": 4113, "sider": 143, "tox21": 783}[name]
