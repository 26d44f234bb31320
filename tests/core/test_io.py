import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings

import otr
from tests.core.strategies import Case, cases, make_network, worked_network
from tests.core.test_tree import random_tree


def tree_of(path: Path) -> otr.ObliqueTree:
    tree = otr.load(path)
    assert isinstance(tree, otr.ObliqueTree)
    return tree


@settings(max_examples=25)
@given(case=cases())
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, case: Case) -> None:
    folder = tmp_path_factory.mktemp("trees")
    tree = otr.map_network(case.network)
    otr.save(tree, folder / "full")
    loaded = tree_of(folder / "full")
    for name in ("children_left", "children_right", "P", "v", "M", "c", "labels"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(tree, name))
    assert loaded.head == tree.head
    np.testing.assert_array_equal(loaded.predict(case.states), tree.predict(case.states))

    for patterns in (otr.PatternTree(case.network).observe(case.states), otr.PatternTree(case.network)):
        for held in [patterns, patterns.observed()] if len(patterns.counts) else [patterns]:
            otr.save(held, folder / "patterns")
            again = otr.load(folder / "patterns")
            assert isinstance(again, otr.PatternTree)
            assert again.is_restricted == held.is_restricted
            np.testing.assert_array_equal(again.patterns, held.patterns)
            np.testing.assert_array_equal(again.counts, held.counts)
            np.testing.assert_array_equal(again.predict(case.states), held.predict(case.states))


def test_names_of_files(tmp_path: Path) -> None:
    tree = otr.map_network(worked_network())
    for given_path, name in ((tmp_path, "tree"), (tmp_path / "a.b", "a.b"), (tmp_path / "c.json", "c")):
        assert otr.save(tree, given_path) == tmp_path / f"{name}.json"
        assert (tmp_path / f"{name}.npz").exists()
        assert tree_of(given_path).n_leaves == 8
    assert tree_of(tmp_path / "c.npz").n_leaves == 8
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".json"] * 3 + [".npz"] * 3


def test_the_same_tree_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        otr.save(otr.map_network(worked_network()), tmp_path / name)
    for suffix in (".npz", ".json"):
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    description = json.loads((tmp_path / "a.json").read_text())
    assert (description["schema"], description["kind"]) == ("otr/tree/1", "oblique_tree")
    assert description["shapes"]["M"] == [8, 1, 2]


def test_a_failed_save_leaves_the_old_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    otr.save(otr.map_network(worked_network()), tmp_path / "tree")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def no_space(*_: object, **__: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez", no_space)
    with pytest.raises(OSError, match="no space"):
        otr.save(random_tree(np.random.default_rng(0), 3, 2, 1, 2), tmp_path / "tree")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_missing_files(tmp_path: Path) -> None:
    with pytest.raises(otr.ArtefactError, match="does not exist; save a tree there first"):
        otr.load(tmp_path / "none")
    otr.save(otr.map_network(worked_network()), tmp_path / "tree")
    (tmp_path / "tree.npz").unlink()
    with pytest.raises(otr.ArtefactError, match=r"tree\.npz does not exist"):
        otr.load(tmp_path)


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_a_file_cut_off_anywhere_is_refused(tmp_path: Path, suffix: str) -> None:
    otr.save(otr.map_network(worked_network()), tmp_path / "tree")
    path = tmp_path / f"tree{suffix}"
    whole = path.read_bytes()
    for length in range(0, len(whole) - 1, 37):  # the last byte of the JSON is a newline
        path.write_bytes(whole[:length])
        with pytest.raises(otr.ArtefactError):
            otr.load(tmp_path)


def test_a_changed_byte_is_refused_or_harmless(tmp_path: Path) -> None:
    tree = otr.map_network(worked_network())
    otr.save(tree, tmp_path / "tree")
    path = tmp_path / "tree.npz"
    whole = path.read_bytes()
    n_refused = 0
    positions = range(0, len(whole), 11)
    for position in positions:
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x10]) + whole[position + 1 :])
        try:
            np.testing.assert_array_equal(tree_of(tmp_path).M, tree.M)  # some bytes are the archive's dates
        except otr.ArtefactError:
            n_refused += 1
    assert n_refused > len(positions) / 2


def test_tampered_arrays_and_heads_are_refused(tmp_path: Path) -> None:
    tree = otr.map_network(make_network(np.random.default_rng(0), (2,), head="clip_box"))
    otr.save(tree, tmp_path / "tree")
    with np.load(tmp_path / "tree.npz") as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "tree.npz", **{**arrays, "c": arrays["c"] + 1})
    with pytest.raises(otr.ArtefactError, match="do not belong together"):
        otr.load(tmp_path)
    np.savez(tmp_path / "tree.npz", **arrays)
    assert tree_of(tmp_path).n_leaves == 4
    text = (tmp_path / "tree.json").read_text()
    (tmp_path / "tree.json").write_text(text.replace("clip_box", "tanh_box"))
    with pytest.raises(otr.ArtefactError, match="do not belong together"):
        otr.load(tmp_path)


@pytest.mark.parametrize("text", ["[]", "{}", '{"schema": "otr/tree/2"}', "null", "\x00\xff"])
def test_another_schema_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "tree.json").write_text(text, encoding="latin-1")
    with pytest.raises(otr.ArtefactError, match=r"schema|JSON"):
        otr.load(tmp_path)


def test_pickled_arrays_are_refused(tmp_path: Path) -> None:
    otr.save(otr.map_network(worked_network()), tmp_path / "tree")
    np.savez(tmp_path / "tree.npz", P=np.array([{}], dtype=object))
    with pytest.raises(otr.ArtefactError, match="cannot be read"):
        otr.load(tmp_path)
