"""How far a command is: on a terminal alone, and where it takes long."""

import pytest

from pipelines.engine import console


@pytest.mark.parametrize(
    ("terminal", "patience", "told"),
    [(True, -1.0, "\rjobs: 0 of 2\rjobs: 1 of 2\r\x1b[K"), (True, 60.0, ""), (False, -1.0, "")],
)
def test_a_terminal_is_told_where_it_takes_long(monkeypatch, capsys, terminal, patience, told):
    monkeypatch.setattr(console, "PATIENCE_S", patience)
    monkeypatch.setattr("sys.stderr.isatty", lambda: terminal)
    assert list(console.counted(["a", "b"], "jobs")) == ["a", "b"]
    assert capsys.readouterr() == ("", told)
