"""Reading split files: fingerprints, quoted names, missing labels; and labels one at a time."""

import numpy as np
import pytest

from pipelines.datasets import Dataset, Part
from pipelines.datasets.molecules import parse_split
from pipelines.errors import ConfigError

from .conftest import split_file


def test_bits_and_labels_come_back_in_place():
    names, X, Y = parse_split(split_file("a,b", (0, "1,0"), (2047, "0,1"), (700, "1,1")))
    assert names == ("a", "b")
    assert X.shape == (3, 2048) and X.dtype == np.uint8
    assert np.argwhere(X).tolist() == [[0, 0], [1, 2047], [2, 700]]
    assert Y.tolist() == [[1, 0], [0, 1], [1, 1]] and Y.dtype == np.float64


def test_commas_in_quoted_names_do_not_split_them():
    names, _, Y = parse_split(split_file('"Neoplasms, benign (incl cysts)",Ear', (3, "1,0")))
    assert names == ("Neoplasms, benign (incl cysts)", "Ear")
    assert Y.tolist() == [[1, 0]]


def test_empty_labels_are_missing():
    _, _, Y = parse_split(split_file("a,b,c", (0, ",,1"), (1, "0,,"), (2, ",,")))
    np.testing.assert_array_equal(Y, [[np.nan, np.nan, 1], [0, np.nan, np.nan], [np.nan] * 3])


def test_a_file_without_rows_is_empty():
    _, X, Y = parse_split(b"smiles,a,b\n")
    assert X.shape == (0, 2048) and Y.shape == (0, 2)


@pytest.mark.parametrize(
    "content, message",
    [
        (split_file("a", (0, "1"))[:-1], "the last line does not end"),
        (b"", "the last line does not end"),
        (split_file("a", (0, "1"), (1, "1,0")), "line 3: 2 labels where the header has 1"),
        (split_file("a", (0, "1")) + b"0101,1\n", "line 3: 2048 characters and a comma"),
        (split_file("a", (0, "1")).replace(b"\n1", b"\n2"), "line 2: the fingerprint"),
        (split_file("a", (0, "yes")), "a label is no number"),
    ],
)
def test_another_form_says_where(content, message):
    with pytest.raises(ValueError, match=message):
        parse_split(content)


@pytest.fixture
def dataset():
    X = np.arange(8, dtype=np.uint8).reshape(4, 2)
    Y = np.array([[1, np.nan], [0, 1], [np.nan, np.nan], [1, 0]])
    part = Part(X, Y)
    return Dataset("toy", "classification", ("a", "b, c"), ("x", "y"), part, part, Part(X[:2], Y[:2]))


def test_one_label_drops_its_missing_rows_only(dataset):
    X, y = dataset.labelled("train", 0)
    assert (X.tolist(), y.tolist(), y.dtype) == ([[0, 1], [2, 3], [6, 7]], [1, 0, 1], np.int64)
    X, y = dataset.labelled("train", "b, c")
    assert (X.tolist(), y.tolist()) == ([[2, 3], [6, 7]], [1, 0])
    X, y = dataset.labelled("test", 0)
    assert X is dataset.test.X and y.tolist() == [1, 0]


@pytest.mark.parametrize("label", ["c", 2, -1])
def test_an_unknown_label_is_named(dataset, label):
    with pytest.raises(ConfigError, match="toy has no label"):
        dataset.labelled("train", label)


def test_rows_of_features_and_labels_must_match():
    with pytest.raises(ValueError, match=r"X is \(3, 2\) and Y is \(2, 1\)"):
        Part(np.zeros((3, 2)), np.zeros((2, 1)))
