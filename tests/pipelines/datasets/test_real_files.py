"""LCN's own files, where they are at hand: sizes and shares as published with them, to four digits."""

import numpy as np
import pytest

from pipelines.datasets import load_dataset

SIZES = {
    "bace": ((1210, 151, 152), 1, (0.4256, 0.5563, 0.6053), (0, 0, 0)),
    "hiv": ((32901, 4113, 4113), 1, (0.0374, 0.0197, 0.0316), (0, 0, 0)),
    "sider": ((1141, 143, 143), 27, (0.5671, 0.5646, 0.5742), (0, 0, 0)),
    "tox21": ((6264, 784, 783), 12, (0.0743, 0.0727, 0.0850), (12832, 1584, 1610)),
}


@pytest.mark.parametrize("name", SIZES)
def test_sizes_and_shares(real_data, name):
    n_rows, n_labels, shares, n_missing = SIZES[name]
    dataset = load_dataset(name)
    parts = [dataset.train, dataset.valid, dataset.test]
    assert tuple(part.X.shape for part in parts) == tuple((n, 2048) for n in n_rows)
    assert tuple(part.Y.shape for part in parts) == tuple((n, n_labels) for n in n_rows)
    assert tuple(round(float(np.nanmean(part.Y)), 4) for part in parts) == shares
    assert tuple(int(np.isnan(part.Y).sum()) for part in parts) == n_missing
    assert all(part.X.dtype == np.uint8 and part.X.max() == 1 for part in parts)
    assert len(dataset.label_names) == n_labels and dataset.feature_names[-1] == "bit2047"


def test_fingerprints_are_those_of_the_text(real_data):
    import gzip

    path = real_data / "lcn" / "tox21_split" / "valid.fgp2048.csv"
    text = (
        path.read_text() if path.exists() else gzip.decompress(path.with_name(f"{path.name}.gz").read_bytes()).decode()
    )
    lines = [line.split(",") for line in text.splitlines()[1:]]
    valid = load_dataset("tox21").valid
    assert [[int(c) for c in line[0]] for line in lines[:50]] == valid.X[:50].tolist()
    written = [["" if np.isnan(y) else str(int(y)) for y in row] for row in valid.Y]
    assert written == [line[1:] for line in lines]


def parts_of(dataset):
    return [dataset.train, dataset.valid, dataset.test]


def shared_scaffolds(dataset):
    train, valid, test = (set(part.groups.tolist()) for part in parts_of(dataset))
    return len(train & valid), len(train & test), len(valid & test)


def test_parts_drawn_anew_have_whole_scaffolds_and_the_same_molecules(real_data):
    published, fresh = load_dataset("bace"), load_dataset("bace", split=0)
    assert (
        shared_scaffolds(published) == shared_scaffolds(fresh) == (0, 0, 0)
    )  # LCN's rule for Bace is by scaffolds, too
    assert [len(part.X) for part in parts_of(fresh)] == [1210, 151, 152]
    told = [
        sorted(
            (part.X[i].tobytes(), part.Y[i, 0], part.groups[i]) for part in parts_of(each) for i in range(len(part.X))
        )
        for each in (published, fresh)
    ]
    assert told[0] == told[1]
    assert not np.array_equal(load_dataset("bace", split=1).test.X, fresh.test.X)
    assert min(shared_scaffolds(load_dataset("sider"))) > 0 and shared_scaffolds(load_dataset("sider", split=3)) == (
        0,
        0,
        0,
    )


def test_folds_are_of_whole_scaffolds_and_leave_the_test_part_out(real_data):
    dataset = load_dataset("bace")
    folds = dataset.folds()
    assert [shared_scaffolds(fold) for fold in folds] == [(0, 0, 0)] * 5
    scored = np.concatenate([fold.test.groups for fold in folds])
    assert sorted(scored.tolist()) == sorted([*dataset.train.groups.tolist(), *dataset.valid.groups.tolist()])
    assert not set(scored.tolist()) & set(dataset.test.groups.tolist())
    assert all(len(part.X) in (272, 273, 816, 817) for fold in folds for part in parts_of(fold))
