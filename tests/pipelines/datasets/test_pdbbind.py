"""PDBbind's pickle: arrays are read, whatever else a pickle may hold is refused without being run."""

import collections
import gzip
import os
import pickle

import numpy as np
import pytest

from pipelines.datasets import catalogue, load_dataset, pdbbind
from pipelines.datasets.catalogue import DataFile, git_blob_hash
from pipelines.datasets.pdbbind import unpickle_arrays
from pipelines.errors import MissingInputError, PipelineError

PATH = "lcn/PDBbind.pkl.gz"


def six(n_features=2052, dtype=np.float64, shape=lambda n: (n,)):
    rng = np.random.default_rng(0)
    arrays = []
    for n_rows in (5, 3, 2):
        arrays += [rng.integers(0, 9, (n_rows, n_features)).astype(dtype), rng.normal(6, 2, shape(n_rows))]
    return tuple(arrays)


def put(monkeypatch, own, packed):
    """Put a file where PDBbind's is looked for, and make its hash the right one."""
    file = DataFile(PATH, None, git_blob_hash(packed), None)
    monkeypatch.setattr(pdbbind, "PDBBIND", file)
    (own / "lcn").mkdir(parents=True)
    (own / PATH).write_bytes(packed)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_six_arrays_come_back(monkeypatch, own, protocol):
    arrays = six()
    put(monkeypatch, own, gzip.compress(pickle.dumps(arrays, protocol=protocol)))
    dataset = load_dataset("pdbbind")
    assert (dataset.task, dataset.label_names, len(dataset.feature_names)) == ("regression", ("affinity",), 2052)
    for i, part in enumerate(("train", "valid", "test")):
        np.testing.assert_array_equal(dataset.part(part).X, arrays[2 * i])
        np.testing.assert_array_equal(dataset.part(part).Y[:, 0], arrays[2 * i + 1])
    X, y = dataset.labelled("valid")
    assert X.dtype == np.float32 and y.dtype == np.float64 and y.shape == (3,)


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "i8", "u1", "?"])
@pytest.mark.parametrize("protocol", [2, 5])
def test_other_number_types_and_layouts(dtype, protocol):
    arrays = six(8, dtype, shape=lambda n: (n, 1))
    arrays = (np.asfortranarray(arrays[0]), *arrays[1:])
    found = unpickle_arrays(pickle.dumps(list(arrays), protocol=protocol))
    for array, due in zip(found, arrays, strict=True):
        np.testing.assert_array_equal(array, due)
        assert array.dtype.kind == due.dtype.kind


def test_names_of_old_and_new_numpy_are_known():
    # numpy.core in files of 2019, numpy._core since NumPy 2; protocol 0 is text, where one can replace the other.
    new = pickle.dumps(six(4), protocol=0)
    assert b"numpy._core.multiarray" in new
    old = new.replace(b"numpy._core", b"numpy.core")
    for content in (new, old):
        np.testing.assert_array_equal(unpickle_arrays(content)[0], six(4)[0])


class Runs:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.fixture
def mark(tmp_path):
    return tmp_path / "it ran"


@pytest.mark.parametrize("protocol", [0, 4])
@pytest.mark.parametrize(
    "make",
    [
        lambda mark: Runs(os.system, f"touch '{mark}'"),
        lambda mark: Runs(eval, f"open({str(mark)!r}, 'w')"),
        lambda mark: (*six(4)[:5], Runs(os.mkdir, str(mark))),
        lambda mark: np.array([Runs(os.mkdir, str(mark))], dtype=object),
        lambda mark: Runs(np.save, str(mark), 1),
        lambda mark: Runs(__import__, "this"),
        lambda mark: collections.OrderedDict(a=1),
    ],
)
def test_a_malicious_pickle_is_refused_before_it_runs(monkeypatch, own, mark, make, protocol):
    content = pickle.dumps(make(mark), protocol=protocol)
    put(monkeypatch, own, gzip.compress(content))
    with pytest.raises(PipelineError, match="cannot be read: it is no pickle of plain numeric arrays"):
        load_dataset("pdbbind")
    assert not mark.exists() and not mark.with_suffix(".npy").exists()


@pytest.mark.parametrize(
    "content, message",
    [
        (b"cnumpy.core.multiarray\nscalar\n.", "numpy.core.multiarray.scalar is refused"),
        (b"cbuiltins\neval\n.", "builtins.eval is refused"),
        (b"", "Ran out of input"),
        (b"(lp0\n.", "it holds a list and not six arrays"),
        (b"(I1\nI2\nI3\nI4\nI5\nI6\nt.", "something else than six arrays"),
        (pickle.dumps([np.array([None])] * 6), "something else than six arrays"),
        (pickle.dumps(six(4), protocol=4)[:-40], "it is no pickle of plain numeric arrays"),
    ],
)
def test_crafted_opcodes_are_refused(content, message):
    with pytest.raises(ValueError, match=message):
        unpickle_arrays(content)


@pytest.mark.parametrize(
    "arrays, message",
    [
        (six(2048), r"x is \(5, 2048\) and y is \(5,\)"),
        (six(shape=lambda n: (n + 1,)), r"and y is \(6,\)"),
        (six(shape=lambda n: (n, 2)), r"and y is \(5, 2\)"),
        ((np.full((5, 2052), np.nan), *six()[1:]), "not finite"),
        (six()[:4], "not six arrays"),
    ],
)
def test_arrays_of_another_form_are_refused(monkeypatch, own, arrays, message):
    put(monkeypatch, own, gzip.compress(pickle.dumps(arrays)))
    with pytest.raises(PipelineError, match=message):
        load_dataset("pdbbind")


def test_another_file_is_not_even_unpacked(own):
    (own / "lcn").mkdir(parents=True)
    (own / PATH).write_bytes(gzip.compress(pickle.dumps(six())))
    with pytest.raises(PipelineError, match=catalogue.PDBBIND.git_blob):
        load_dataset("pdbbind")


def test_without_the_file_the_message_has_address_hash_and_place(server, own):
    with pytest.raises(MissingInputError) as caught:
        load_dataset("pdbbind")
    assert server.asked == ["/pinned/PDBbind.pkl.gz", "/master/PDBbind.pkl.gz"]
    for part in (*catalogue.PDBBIND.addresses, catalogue.PDBBIND.git_blob, str(own / PATH), "404"):
        assert part in str(caught.value)


def test_it_is_fetched_and_kept_as_it_comes(server, own, monkeypatch):
    packed = gzip.compress(pickle.dumps(six()))
    monkeypatch.setattr(pdbbind, "PDBBIND", DataFile(PATH, None, git_blob_hash(packed), None))
    server.answers["/pinned/PDBbind.pkl.gz"] = packed
    assert len(load_dataset("pdbbind").train.X) == 5
    assert (own / PATH).read_bytes() == packed
