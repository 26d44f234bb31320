"""Tables of the user: how columns become features, by training rows alone, and what is refused with what to do."""

import numpy as np
import pandas as pd
import pytest

from pipelines.datasets import Columns, load_table
from pipelines.errors import ConfigError


def frame(n: int = 200) -> pd.DataFrame:
    rng = np.random.default_rng(0)
    made = pd.DataFrame(
        {
            "size": rng.normal(100, 20, n),
            "colour": rng.choice(["red", "green", "blue"], n),
            "town": ["A", "B"] * (n // 2),
        }
    )
    made["age"] = rng.integers(0, 50, n).astype(float)
    made["price"] = made["size"] * 2 + (made["colour"] == "red")
    made["grade"] = np.where(made["price"] > 200, "good", "bad")
    made.loc[::5, "age"] = np.nan
    return made


@pytest.fixture
def path(tmp_path):
    frame().to_csv(tmp_path / "my.csv", index=False)
    return tmp_path / "my.csv"


def test_categories_are_indicators_and_what_is_missing_is_said(path):
    dataset = load_table(path, "price", drop=["grade"])
    colours = ("colour == blue", "colour == green", "colour == red")
    assert dataset.feature_names == ("size", *colours, "town == A", "age", "age is missing")
    assert (dataset.task, dataset.label_names, dataset.columns.classes) == ("regression", ("price",), None)
    assert [len(dataset.part(part).X) for part in ("train", "valid", "test")] == [160, 20, 20]
    age, missing = dataset.train.X[:, 5], dataset.train.X[:, 6]
    assert 0 < missing.mean() < 1 and np.unique(age[missing == 1]) == [np.median(age[missing == 0])]
    assert dataset.train.X[:, 1:4].sum(axis=1).tolist() == [1.0] * 160


@pytest.mark.parametrize("name", ["my.csv", "my.tsv", "my.csv.gz", "my.parquet"])
def test_a_new_row_is_encoded_as_the_training_rows_were(tmp_path, name):
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
        frame().to_parquet(tmp_path / name)
    else:
        frame().to_csv(tmp_path / name, index=False, sep="\t" if name == "my.tsv" else ";")
    dataset = load_table(tmp_path / name, "grade", drop=["price"], split=3)
    dataset.columns.write(tmp_path / "columns.json")
    columns = Columns.read(tmp_path / "columns.json")
    assert columns == dataset.columns and columns.classes == ("bad", "good")
    rows = pd.DataFrame({"age": [None, 7.0], "town": ["A", "Z"], "colour": ["pink", "red"], "size": [1, 2]}).assign(
        more=0
    )
    fill = columns.columns[-1].fill
    assert columns.encode(rows).tolist() == [[1, 0, 0, 0, 1, fill, 1], [2, 0, 0, 1, 0, 7, 0]]
    with pytest.raises(ConfigError, match=r"no column 'size'\. Did you mean sise"):
        columns.encode(rows.rename(columns={"size": "sise"}))
    with pytest.raises(ConfigError, match="column 'size' holds numbers"):
        columns.encode(rows.assign(size="big"))


def test_decimal_commas_are_numbers_where_semicolons_part_the_columns(tmp_path):
    made = frame().drop(columns="town").assign(size=np.linspace(-3, 3, 200))
    made.to_csv(tmp_path / "points.csv", index=False)
    made.to_csv(tmp_path / "commas.csv", index=False, sep=";", decimal=",")
    points, commas = (load_table(tmp_path / f"{name}.csv", "price", drop=["grade"]) for name in ("points", "commas"))
    assert commas.feature_names == points.feature_names
    for part in ("train", "test"):
        assert (commas.part(part).X == points.part(part).X).all() and (commas.part(part).Y == points.part(part).Y).all()


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (('"size","y"', '"1.5","a"', '"2","b"'), ("size",)),
        (('"sales, EUR",y', "1,a", "2,b"), ("sales, EUR",)),
        (("Umsatz, EUR;Menge, kg;y", "1,5;2,25;a", "2;3;b"), ("Umsatz, EUR", "Menge, kg")),
        (('"a\nb",y', "1,a", "2,b"), ("a\nb",)),
        (("code,y", "007,a", "07,b", "x,a"), ("code == 007", "code == 07", "code == x")),
        (("kind,y", "None,a", "Some,b", "?,a"), ("kind == None", "kind == Some", "kind is missing")),
        (("size,y", "NA,a", "1e3,b", "2,a", "nan,a"), ("size", "size is missing")),
        (("big,y", "12345678901234567890,a", "1,b"), ("big",)),
    ],
)
def test_what_a_file_holds_is_read_as_it_is_written(tmp_path, lines, expected):
    head, *rows = lines
    (tmp_path / "my.csv").write_text("\n".join([head, *(rows * 40)]) + "\n", encoding="utf-8")
    dataset = load_table(tmp_path / "my.csv", "y")
    assert dataset.feature_names == expected and len(dataset.train.X) >= 60
    assert np.isfinite(dataset.train.X).all() and np.ptp(dataset.train.X, axis=0).all()


def test_a_file_of_new_rows_is_read_as_the_training_rows_were(tmp_path):
    """Alone, pandas would read 01 as the number 1, and TRUE as a truth value."""
    rows = [
        f"{code},{flag},{'yes' if code == '01' else 'no'}" for code in ("01", "02", "A1") for flag in ("TRUE", "no")
    ]
    (tmp_path / "my.csv").write_text("\n".join(["code,flag,y", *(rows * 20)]))
    columns = load_table(tmp_path / "my.csv", "y").columns
    assert columns.feature_names == ("code == 01", "code == 02", "code == A1", "flag == TRUE")
    (tmp_path / "new.csv").write_text("code,flag\n01,TRUE\n02,TRUE\n01,TRUE\n")
    assert columns.encode(tmp_path / "new.csv").tolist() == [[1, 0, 0, 1], [0, 1, 0, 1], [1, 0, 0, 1]]
    with pytest.raises(ConfigError, match="column 'code' holds texts, as 01, and these rows have numbers, as 1"):
        columns.encode(pd.read_csv(tmp_path / "new.csv"))


@pytest.mark.parametrize(
    ("lines", "target", "message"),
    [
        (("income\ty", "4,253\ta", "999\tb"), "y", "'income' has 4,253, a thousand or a decimal: write it as 4253"),
        (('y,income', 'a,"4,253"', "b,999"), "y", "column 'income' has 4,253"),
        ((",size,y", *(f"{i},{i % 3},a\n{i + 1},{i % 5},b" for i in range(0, 80, 2))), "y",
         "Unnamed: 0: whole numbers without a name.*\n.*\"drop=\\['Unnamed: 0'\\]\""),
        (("size,y", "1,2.5", "2,inf", "3,4"), "y", "target=y: it holds infinity"),
    ],
)  # fmt: skip
def test_what_may_be_read_in_two_ways_is_refused(tmp_path, lines, target, message):
    head, *rows = lines
    (tmp_path / "my.csv").write_text("\n".join([head, *(rows if len(rows) > 20 else rows * 40)]) + "\n")
    with pytest.raises(ConfigError, match=message):
        load_table(tmp_path / "my.csv", target)


def test_rows_without_a_target_are_counted(tmp_path, capsys):
    frame().assign(price=[np.nan] * 7 + [1.0, 2.0, 3.0] * 64 + [4.0]).to_csv(tmp_path / "my.csv", index=False)
    load_table(tmp_path / "my.csv", "price")
    assert "7 of 200 rows have no price and are left out" in capsys.readouterr().out


def test_rows_that_are_held_out_decide_nothing(tmp_path):
    """Whatever stands in the validation and test rows, columns and training features are the same."""
    made = frame()
    made.to_csv(tmp_path / "a.csv", index=False)
    first = load_table(tmp_path / "a.csv", "price", drop=["grade"])
    held_out = ~np.isin(np.arange(200), np.flatnonzero(np.isin(made["price"].round(9), first.train.Y.ravel().round(9))))
    assert held_out.sum() == 40
    made.loc[held_out, ["size", "age"]] = 1e6
    made.loc[held_out, "colour"] = "violet"
    made.to_csv(tmp_path / "a.csv", index=False)
    other = load_table(tmp_path / "a.csv", "price", drop=["grade"])
    assert other.columns == first.columns
    np.testing.assert_array_equal(other.train.X, first.train.X)


def test_the_targets_type_says_the_task(tmp_path):
    made = frame()
    for target, task, wanted, classes in (
        (made["size"] > 100, None, "classification", ("False", "True")),
        (np.where(made["size"] > 100, 1.0, np.nan), None, None, None),
        (np.where(made["size"] > 100, 1, 0), None, "classification", None),
        (np.arange(200) % 7, None, "regression", None),
        (np.arange(200) % 7, "counts", "counts", None),
        (np.arange(200) % 3, "classification", "classification", None),
    ):
        made.assign(y=target).to_csv(tmp_path / "t.csv", index=False)
        if wanted is None:
            with pytest.raises(ConfigError, match="target=y: every row has"):
                load_table(tmp_path / "t.csv", "y", task=task)
            continue
        dataset = load_table(tmp_path / "t.csv", "y", task=task)
        assert (dataset.task, dataset.columns.classes) == (wanted, classes)
        if wanted == "classification":  # of each class alike in all parts
            shares = [np.mean(dataset.part(part).Y == 1) for part in ("train", "test")]
            assert shares[0] == pytest.approx(shares[1], abs=0.06)


@pytest.mark.parametrize(
    ("options", "change", "message"),
    [
        ({"target": "prise"}, {}, "no column 'prise'. Did you mean price"),
        ({"target": None}, {}, "Add target=NAME with one of: size, colour, town, age, price, grade"),
        ({"drop": ["aeg"]}, {}, "no column 'aeg'. Did you mean age"),
        ({}, {"price": 3.0}, "target=price: every row has 3.0, so that there is nothing to learn"),
        ({}, {"id": range(200)}, r"id: another whole number in each row, as an id\nLeave them out with drop=\[id\]"),
        ({}, {"note": [f"n{i}" for i in range(200)]}, "note: another text in each row, as an id: n0, n1"),
        ({}, {"zip": [f"n{i % 99}" for i in range(200)]}, "zip: 99 different texts, as n0; a category may have 64"),
        ({}, {"day": pd.date_range("2020-01-01", periods=200)}, "day: dates, as 2020-01-01"),
        ({}, {"void": None}, "void: no value in a training row"),
        ({}, {"size": np.inf}, "column 'size' holds infinity"),
        ({"target": "day"}, {"day": pd.date_range("2020-01-01", periods=200)}, "target=day: it has dates"),
        ({"target": "grade", "task": "counts"}, {}, "task=counts is for numbers, and it has '(bad|good)'"),
        ({"target": "age", "task": "counts"}, {"age": 0.5 + np.arange(200)}, "task=counts is for whole numbers"),
        ({"target": "grade"}, {"grade": ["one", *["a", "b"] * 99, "b"]}, "one row alone is 'one'; a class needs two"),
    ],
)
def test_what_cannot_be_learnt_is_said_with_what_to_do(tmp_path, options, change, message):
    frame().assign(**change).to_csv(tmp_path / "my.csv", index=False)
    with pytest.raises(ConfigError, match=message):
        load_table(tmp_path / "my.csv", **({"target": "price", "drop": ["grade"][: "target" not in options]} | options))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "there is no such file"),
        (b"", "cannot be read as a table"),
        (b"a,b\n1,\xff\n", "cannot be read as a table"),
        (b"a,b\n1,2\n3,4\n", "has 2 rows with a target; give 20 at least"),
    ],
)
def test_a_file_that_is_no_table_is_refused(tmp_path, content, message):
    if content is not None:
        (tmp_path / "my.csv").write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        load_table(tmp_path / "my.csv", "a")
