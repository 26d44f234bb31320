import io
import json
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import otr
from otr.files.artefacts import _digest
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


def test_the_same_tree_gives_the_same_bytes_whatever_the_name(tmp_path: Path) -> None:
    tree = otr.map_network(worked_network())
    for given_path, name in ((tmp_path, "tree"), (tmp_path / "a.b", "a.b"), (tmp_path / "c.json", "c")):
        assert otr.save(tree, given_path) == tmp_path / f"{name}.json"
        assert tree_of(given_path).n_leaves == 8
        for suffix in (".npz", ".json"):
            assert (tmp_path / f"{name}{suffix}").read_bytes() == (tmp_path / f"tree{suffix}").read_bytes()
    assert tree_of(tmp_path / "c.npz").n_leaves == 8 and len(list(tmp_path.iterdir())) == 6
    description = json.loads((tmp_path / "c.json").read_text())
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


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_a_file_cut_off_anywhere_is_refused(tmp_path: Path, suffix: str) -> None:
    otr.save(otr.map_network(worked_network()), tmp_path / "tree")
    path = tmp_path / f"tree{suffix}"
    whole = path.read_bytes()
    for length in range(0, len(whole) - 1, 37):  # the last byte of the JSON is a newline
        path.write_bytes(whole[:length])
        with pytest.raises(otr.ArtefactError):
            otr.load(tmp_path)


def test_files_that_are_missing_or_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    def refused(words: str) -> None:
        with pytest.raises(otr.ArtefactError, match=words):
            otr.load(tmp_path)

    refused("does not exist; save a tree there first")
    otr.save(otr.map_network(make_network(np.random.default_rng(0), (2,), head="clip_box")), tmp_path / "tree")
    with np.load(tmp_path / "tree.npz") as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "tree.npz", **{**arrays, "c": arrays["c"] + 1})
    refused("do not belong together")
    np.savez(tmp_path / "tree.npz", P=np.array([{}], dtype=object))
    refused("cannot be read")
    np.savez(tmp_path / "tree.npz", **arrays)
    assert tree_of(tmp_path).n_leaves == 4
    text = (tmp_path / "tree.json").read_text()
    (tmp_path / "tree.json").write_text(text.replace("clip_box", "tanh_box"))
    refused("do not belong together")
    for other in ("[]", "{}", '{"schema": "otr/tree/2"}', "null", "\x00\xff"):
        (tmp_path / "tree.json").write_text(other, encoding="latin-1")
        refused("schema|JSON|do not belong together")
    (tmp_path / "tree.json").write_text(text)
    rewritten(tmp_path, "P.npy", encrypted=True)
    refused("is encrypted")
    (tmp_path / "tree.npz").unlink()
    refused(r"tree\.npz does not exist")


def test_what_cannot_be_saved_is_named(tmp_path: Path) -> None:
    with pytest.raises(otr.ArtefactError, match=f"there is no folder {tmp_path / 'missing'} to save x.npz in; make it"):
        otr.save(otr.map_network(worked_network()), tmp_path / "missing" / "x")
    with pytest.raises(TypeError, match=r"tree is a ReluNetwork, .* otr.PatternTree\(network\) holds a network"):
        otr.save(worked_network(), tmp_path / "x")
    assert list(tmp_path.iterdir()) == []


def rewritten(folder: Path, name: str, *, encrypted: bool = False, content: bytes | None = None) -> None:
    """Write tree.npz again with a member marked as encrypted, or of other content."""
    path = folder / "tree.npz"
    with zipfile.ZipFile(path) as archive:
        members = {member: archive.read(member) for member in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for member, held in members.items():
            archive.writestr(member, content if content is not None and member == name else held)
    whole = bytearray(path.read_bytes())
    for magic, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        whole[whole.index(magic) + offset] |= encrypted
    path.write_bytes(bytes(whole))


def npy(shape: str, kind: str = "<f8", n_bytes: int = 64, version: int = 1) -> bytes:
    """Return a file in numpy's format whose header holds `shape` as it is."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY" + bytes([version, 0]) + len(header).to_bytes(2, "little") + header + bytes(n_bytes)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (npy("(1000000000000,)"), "takes 8000000000000 bytes, the file has 64"),
        (npy("(8,)", n_bytes=65), "takes 64 bytes, the file has 65"),
        (npy("(True, 8)"), r"the shape \(True, 8\), expected numbers"),
        (npy("(8,)", kind="|O"), "the type object"),
        (npy("(8,)", version=9), r"the format \(9, 0\), expected one of"),
        (npy("(8,"), "header is broken"),
        (npy("(" * 5000), "header is broken"),
        (npy("8"), "shape is not valid|header is broken"),
        (npy("(8,)", kind="nonsense"), "descr is not a valid dtype|header is broken"),
        (b"\x93NUMPY", "EOF|magic"),
        (b"not an array", "magic string"),
        (b"", "EOF|magic"),
    ],
)
def test_headers_are_checked_before_anything_is_allocated(tmp_path: Path, content: bytes, words: str) -> None:
    otr.save(otr.map_network(worked_network()), tmp_path / "tree")
    rewritten(tmp_path, "P.npy", content=content)
    tracemalloc.start()
    with pytest.raises(otr.ArtefactError, match=rf"tree\.npz cannot be read .*({words})"):
        otr.load(tmp_path)
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()


def signed(folder: Path, changes: dict[str, Any], arrays: dict[str, Any] | None = None) -> None:
    """Change the JSON file of a saved tree, and the arrays, under a digest that fits."""
    description = json.loads((folder / "tree.json").read_text()) | changes
    with np.load(folder / "tree.npz") as archive:
        held = dict(archive) | (arrays or {})
    description["sha256"] = _digest(description, held)
    np.savez(folder / "tree.npz", **held)
    (folder / "tree.json").write_text(json.dumps(description))


@pytest.mark.parametrize(
    ("changes", "arrays", "words"),
    [
        ({"head": None}, {}, "head is None in the JSON file, expected dict"),
        ({"head": {"name": []}}, {}, "unhashable"),
        ({"head": {"name": "clip_box", "low": 10**400, "high": 1}}, {}, "too large to convert"),
        ({"kind": []}, {}, r"holds the kind \[\], expected one of"),
        ({"schema": {}}, {}, r"has the schema \{\}, expected 'otr/tree/1'"),
        ({"n_layers": 1.0}, {}, "n_layers is 1.0 in the JSON file, expected int"),
        ({"dense": 1}, {}, "dense is 1 in the JSON file, expected bool or str"),
        ({"domain": {"low": [0], "high": [1]}}, {}, "the domain has 1 inputs, expected 2"),
        *[
            ({}, {"counts": np.array(counts)}, r"counts have shape .*, expected \(2,\)")
            for counts in (3, [3], [[3], [4]])
        ],
    ],
)
def test_a_description_that_makes_no_sense_is_refused(tmp_path: Path, changes: dict, arrays: dict, words: str) -> None:
    network = worked_network().replace(domain=([-9.0, -np.inf], [9.0, 9.0]))
    otr.save(otr.PatternTree(network).observe([[-9.0, 0.0], [9.0, 9.0]]), tmp_path / "tree")
    again = otr.load(tmp_path)
    assert isinstance(again, otr.PatternTree) and again.network.domain == network.domain
    signed(tmp_path, changes, arrays)
    with pytest.raises(otr.ArtefactError, match=words):
        otr.load(tmp_path)


def test_json_nested_however_deeply_is_refused(tmp_path: Path) -> None:
    otr.save(otr.map_network(worked_network()), tmp_path / "tree")
    text = (tmp_path / "tree.json").read_text()
    for depth in (300, *range(800, 1000), 200_000):
        (tmp_path / "tree.json").write_text(text.replace('"head"', f'"head": {"[" * depth}{"]" * depth}, "was"'))
        with pytest.raises(otr.ArtefactError, match=r"tree\.json"):
            otr.load(tmp_path)
    (tmp_path / "tree.json").write_text("[" * 200_000)
    with pytest.raises(otr.ArtefactError, match=r"tree\.json cannot be read as JSON"):
        otr.load(tmp_path)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    network = make_network(np.random.default_rng(0), (2, 2), n_outputs=2, head="clip_box")
    folders = [tmp_path_factory.mktemp(name) for name in ("tree", "labels", "patterns")]
    labels = make_network(np.random.default_rng(1), (2,), n_outputs=3, head="argmax")
    paths = otr.PatternTree(network).observe(np.random.default_rng(2).normal(size=(50, 3)))
    for tree, folder in zip((otr.map_network(network), otr.map_network(labels), paths), folders, strict=True):
        otr.save(tree, folder / "tree")
    return folders


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_subnormal=False)
    | st.text(max_size=3) | st.just(10**400) | st.sampled_from(["identity", "tanh_box", "argmax", "all"]),
    lambda inner: st.lists(inner, max_size=3)
    | st.dictionaries(st.sampled_from(["name", "low", "high", "x"]), inner, max_size=3),
    max_leaves=5,
)  # fmt: skip
SHAPES = st.sampled_from(["(8,)", "(0, 8)", "()", "(2, 4)", "(8, 1)", "(1, 8)"])
ARRAYS = st.builds(
    npy, SHAPES, st.sampled_from(["<f8", ">f8", "<i8", "|b1", "<f2", "|u1"]), st.sampled_from([0, 8, 64])
)


@settings(max_examples=150)
@given(data=st.data())
def test_whatever_was_changed_a_tree_or_the_library_s_error(saved: list[Path], data: st.DataObject) -> None:
    folder = data.draw(st.sampled_from(saved))
    written = {path.name: path.read_bytes() for path in folder.iterdir()}
    try:
        way = data.draw(st.sampled_from(["bytes", "description", "array"]))
        if way == "bytes":
            name = data.draw(st.sampled_from(sorted(written)))
            start, length = (data.draw(st.integers(0, n)) for n in (len(written[name]), 30))
            other = data.draw(st.binary(max_size=10))
            (folder / name).write_bytes(written[name][:start] + other + written[name][start + length :])
        elif way == "description":
            keys = sorted(json.loads(written["tree.json"]))
            signed(folder, data.draw(st.dictionaries(st.sampled_from([*keys, "domain"]), JUNK, min_size=1, max_size=2)))
        else:
            with np.load(folder / "tree.npz") as archive:
                held = dict(archive)
            name, content = data.draw(st.sampled_from(sorted(held))), data.draw(ARRAYS)
            try:
                signed(folder, {}, {name: np.load(io.BytesIO(content))})
            except ValueError:  # fewer bytes than the shape asks for: numpy reads none
                rewritten(folder, f"{name}.npy", content=content)
        tree = otr.load(folder)
        tree.predict(np.zeros((2, tree.n_inputs)))
    except otr.ArtefactError:
        pass
    finally:
        for name, content in written.items():
            (folder / name).write_bytes(content)
