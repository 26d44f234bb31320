"""The counts of RAND's Health Insurance Experiment: columns by name, and persons whole in a part."""

import numpy as np
import pytest

from pipelines.datasets import load_dataset, randhie
from pipelines.datasets.catalogue import FILES

HEAD = "mdvis,lncoins,idp,lpi,fmde,physlm,disea,hlthg,hlthf,hlthp"


def test_columns_and_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [[i, i / 1000, i % 2, 6.9, 0, 0, 13.7, 1, 0, 0] for i in range(1050)]
    text = "\n".join([HEAD, *(",".join(map(str, row)) for row in rows)])
    monkeypatch.setattr(randhie, "read", lambda file: text.encode() if file.path == "raw/randhie.csv" else b"")
    dataset = load_dataset("randhie")
    assert dataset.task == "counts" and dataset.label_names == ("visits",)
    assert dataset.feature_names[:2] == ("log_coinsurance", "individual_deductible")
    parts = [dataset.labelled(part)[1] for part in ("train", "valid", "test")]
    assert sorted(np.concatenate(parts)) == list(range(1050))
    blocks = [set(part // 100) for part in parts]
    assert [len(each) for each in blocks] == [8, 2, 1] and not blocks[0] & blocks[1] and not blocks[1] & blocks[2]
    for fold in dataset.folds():
        blocks = [set(part.Y[:, 0] // 100) for part in (fold.train, fold.valid, fold.test)]
        assert not blocks[0] & blocks[1] and not blocks[0] & blocks[2] and not blocks[1] & blocks[2]
    np.testing.assert_allclose(dataset.train.X[:, 0], dataset.train.Y[:, 0] / 1000, rtol=1e-6)


def test_the_address_is_of_a_release() -> None:
    (address,) = FILES["raw/randhie.csv"].addresses
    assert address.endswith("statsmodels/v0.14.4/statsmodels/datasets/randhie/randhie.csv")
