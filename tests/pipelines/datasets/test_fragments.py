"""What bits stand for: the committed table, names for people, and the table made again with RDKit."""

import dataclasses
from importlib import resources

import pytest

from pipelines.datasets import fragment_names, fragments, load_dataset
from pipelines.datasets.catalogue import MOLECULES
from pipelines.datasets.command import main
from pipelines.datasets.fragments import Fragment, find_fragments, read_fragments, write_fragments
from pipelines.errors import ConfigError

from .conftest import expect

COMMITTED = resources.files("pipelines.datasets").joinpath("bace_fragments.csv")


def test_the_table_has_a_row_for_every_bit():
    rows = read_fragments("bace")
    assert [row.bit for row in rows] == list(range(2048))
    for row in rows:
        assert (row.fragment == "") == (row.n_molecules == 0) == (row.share == 0)
        assert 0 <= row.share <= 1
        n_with = row.share * row.n_molecules
        assert n_with == pytest.approx(round(n_with), abs=1e-4 * row.n_molecules)
    assert rows[1057] == Fragment(1057, "[CH3]", 1114, 1.0)  # methyl
    assert rows[699] == Fragment(699, "cF", 531, 1.0)
    assert rows[15] == Fragment(15, "", 0, 0.0)


def test_the_table_counts_the_training_molecules(real_data):
    n_molecules = load_dataset("bace").train.X.sum(axis=0, dtype=int)
    assert [row.n_molecules for row in read_fragments("bace")] == n_molecules.tolist()


def test_names_for_people():
    names = fragment_names("bace")
    assert len(names) == len(set(names)) == 2048
    assert names[1057] == "[CH3] (bit1057)"
    assert names[15] == "bit15"  # in no molecule
    assert names[4] == "bit4"  # of two molecules, each has another fragment
    assert max(map(len, names)) == len("cccccccccccccccccccc (bit1234)")
    assert next(name for name in names if "…" in name).index("… (bit") == 19


def test_data_sets_without_a_table_keep_their_names(own):
    assert fragment_names("tox21")[-1] == "bit2047"  # the data set itself is not here
    assert fragment_names("diabetes")[:2] == ("age", "sex")
    with pytest.raises(ConfigError, match="Did you mean bace"):
        fragment_names("baze")


def test_a_written_table_is_read_as_it_was(tmp_path, monkeypatch):
    rows = (Fragment(0, "cc(c)C", 3, 0.6667), Fragment(1, "", 0, 0.0))
    write_fragments(rows, tmp_path / "table.csv")
    assert (tmp_path / "table.csv").read_bytes() == b"bit,fragment,n_molecules,share\n0,cc(c)C,3,0.6667\n1,,0,0\n"
    monkeypatch.setattr(fragments, "TABLES", {"tiny": str(tmp_path / "table.csv")})
    assert read_fragments("tiny") == rows


@pytest.mark.parametrize(
    "words, message",
    [
        (["diabetes"], "--fragments wants one of bace, hiv, sider, tox21, got diabetes"),
        (["bace", "hiv"], "got bace, hiv"),
        (["--list"], "got none"),
    ],
)
def test_fragments_are_of_one_set_of_molecules(capsys, tmp_path, words, message):
    assert main([*words, "--fragments", str(tmp_path / "table.csv")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "table.csv").exists()


def test_fragments_of_three_molecules(rdkit_at_hand, own, monkeypatch):
    raw = b"mol,Class\nCCO,1\nCCO,1\nCC,1\nC[NH3+],0\n"
    expect(monkeypatch, "raw/bace.csv", raw)
    (own / "raw").mkdir(parents=True)
    (own / "raw" / "bace.csv").write_bytes(raw)
    entry = dataclasses.replace(MOLECULES["bace"], split_rule="random")  # trains on rows 2, 3 and 1
    rows = [row for row in find_fragments(entry) if row.n_molecules]
    assert {(row.fragment, row.n_molecules, row.share) for row in rows} == {
        *(("[CH3]", 3, 1), ("[CH2]", 1, 1), ("[OH]", 1, 1), ("[NH3+]", 1, 1)),
        *(("CC", 1, 1), ("CO", 1, 1), ("CCO", 1, 1), ("C[NH3+]", 1, 1)),
    }


@pytest.mark.slow
def test_the_committed_table_is_made_again(rdkit_at_hand, real_data, capsys, tmp_path):
    if not (real_data / "raw" / "bace.csv").is_file():
        pytest.skip(f"{real_data} has no raw/bace.csv")
    assert main(["bace", "--fragments", str(tmp_path / "table.csv")]) == 0
    assert "bace: fragments of 1,747 bits, of 2,048, in " in capsys.readouterr().out
    assert (tmp_path / "table.csv").read_bytes() == COMMITTED.read_bytes()
