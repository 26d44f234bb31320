"""`otr-data`: the table, the list, and exit codes."""

import pytest

from pipelines.datasets.command import main

from .test_download import served


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")


def test_table_of_what_was_fetched(server, tiny_bace, own, capsys):
    server.answers = served("pinned", tiny_bace)
    assert main(["bace", "diabetes"]) == 0
    printed = capsys.readouterr()
    assert "│ bace     │     2/2/2 │      1 │ .5000/.5000/.5000 │ ok   │" in printed.out
    assert "│ diabetes │ 353/45/44 │      1 │" in printed.out
    assert f"bace: {own / 'lcn' / 'bace_split'}" in printed.out
    assert "diabetes: comes with scikit-learn" in printed.out
    assert f"fetching {server.root}/pinned/bace_split/train.fgp2048.csv" in printed.err


def test_one_failure_does_not_stop_the_others(server, tiny_bace, capsys):
    server.answers = served("pinned", tiny_bace)
    assert main(["pdbbind", "bace"]) == 1
    printed = capsys.readouterr()
    assert "│ bace " in printed.out and "pdbbind" not in printed.out
    assert "otr-data: pdbbind: cannot fetch" in printed.err


def test_list_fetches_nothing(server, tiny_bace, own, capsys):
    (own / "lcn" / "bace_split").mkdir(parents=True)
    (own / "lcn" / "bace_split" / "train.fgp2048.csv").write_bytes(b"")
    assert main(["--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"data folder: {own}"
    assert "  bace           1 of 3 files here" in lines
    assert "  digits         comes with scikit-learn" in lines
    assert len(lines) == 10
    assert server.asked == []


def test_a_wrong_request_is_reported_before_anything_is_fetched(server, capsys):
    assert main(["baze"]) == 2
    assert "otr-data: there is no data set 'baze'. Did you mean bace?" in capsys.readouterr().err
    assert server.asked == []


def test_help_says_where_files_lie(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    printed = capsys.readouterr().out
    assert "~/.local/share/otr" in printed and "OTR_DATA_DIR" in printed and "otr-data bace hiv" in printed
