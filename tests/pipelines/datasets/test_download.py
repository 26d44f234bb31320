"""Fetching: what comes is compared with its hash and kept; every failure is one message that says what to do."""

import gzip
import re
import socket

import pytest

from pipelines.datasets import catalogue, download, load_dataset
from pipelines.datasets.catalogue import FILES
from pipelines.datasets.download import locate, read
from pipelines.errors import ConfigError, MissingInputError, PipelineError

TRAIN = "lcn/bace_split/train.fgp2048.csv"


def served(root, contents):
    return {f"/{root}/{path.partition('/')[2]}": content for path, content in contents.items()}


def test_known_hashes_of_git_and_the_addresses():
    assert catalogue.git_blob_hash(b"") == "e69de29bb2d1d6434b8b29ae775ad8c2e48c5391"  # git hash-object /dev/null
    assert len(FILES) == 14
    assert catalogue.PDBBIND.git_blob == "7c67031042f93fed4674108ea496e76efdfd29ae"
    assert catalogue.PDBBIND.addresses == (
        "https://raw.githubusercontent.com/guanghelee/iclr20-lcn/78d2262207ef/data/PDBbind.pkl.gz",
        "https://raw.githubusercontent.com/guanghelee/iclr20-lcn/master/data/PDBbind.pkl.gz",
    )


def test_fetched_once_and_kept_packed(server, tiny_bace, own):
    server.answers = served("pinned", tiny_bace)
    first = load_dataset("bace")
    assert server.asked == [
        "/pinned/bace_split/train.fgp2048.csv",
        "/pinned/bace_split/valid.fgp2048.csv",
        "/pinned/bace_split/test.fgp2048.csv",
    ]
    kept = own / f"{TRAIN}.gz"
    assert gzip.decompress(kept.read_bytes()) == tiny_bace[TRAIN]
    assert sorted(path.name for path in kept.parent.iterdir()) == [
        f"{part}.fgp2048.csv.gz" for part in ("test", "train", "valid")
    ]
    again = load_dataset("bace")
    assert len(server.asked) == 3
    assert first.train.X.argmax(axis=1).tolist() == again.train.X.argmax(axis=1).tolist() == [0, 10]
    assert again.valid.X.argmax(axis=1).tolist() == [1, 11]
    assert again.test.X.argmax(axis=1).tolist() == [2, 12]


def test_the_second_address_is_tried_where_the_first_has_nothing(server, tiny_bace):
    server.answers = served("master", tiny_bace)
    assert read(FILES[TRAIN]) == tiny_bace[TRAIN]
    assert [path.split("/")[1] for path in server.asked] == ["pinned", "master"]


def assert_says_what_to_do(message, own):
    file = FILES[TRAIN]
    for part in (file.addresses[0], file.git_blob, file.sha256, str(own / TRAIN), "OTR_DATA_DIR"):
        assert part in message
    assert "valid.fgp2048.csv" in message and "test.fgp2048.csv" in message  # they are missing, too


def failing_load(own):
    with pytest.raises(MissingInputError) as caught:
        load_dataset("bace")
    assert_says_what_to_do(str(caught.value), own)
    assert not list(own.rglob("*.csv*"))
    return str(caught.value)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (lambda whole: whole.replace(b",1", b",0"), r"Git blob hash \w+ instead of"),
        (lambda whole: whole + b"x" * 10**6, r"more than the [\d,]+ bytes"),
        (lambda whole: (whole[:1000], len(whole)), "ended after 1,000 of|IncompleteRead"),
    ],
    ids=["other", "too large", "truncated"],
)
def test_another_content_is_refused(server, tiny_bace, own, answer, told):
    other = {"/pinned/bace_split/train.fgp2048.csv": answer(tiny_bace[TRAIN])}
    server.answers = served("pinned", tiny_bace) | other
    assert re.search(told, failing_load(own))


def test_a_server_that_is_not_there(tiny_bace, own, monkeypatch):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{unused.getsockname()[1]}"
    monkeypatch.setattr(catalogue, "LCN_ROOTS", (f"{address}/pinned", f"{address}/master"))
    message = failing_load(own)
    assert "Connection refused" in message
    assert "/master/" not in message.splitlines()[0]


def test_a_server_that_says_nothing(tiny_bace, own, monkeypatch):
    monkeypatch.setattr(download, "TIMEOUT_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setattr(catalogue, "LCN_ROOTS", (f"http://127.0.0.1:{silent.getsockname()[1]}",))
        assert "timed out" in failing_load(own)


def test_a_killed_download_leaves_nothing_that_counts(server, tiny_bace, own, monkeypatch):
    monkeypatch.setattr(download.gzip, "compress", lambda *_, **__: b"half")
    monkeypatch.setattr(download.Path, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    server.answers = served("pinned", tiny_bace)
    with pytest.raises(KeyboardInterrupt):
        load_dataset("bace")
    assert not [path for path in own.rglob("*") if path.is_file()]


def test_a_folder_that_cannot_be_written(server, tiny_bace, own):
    own.parent.mkdir(parents=True)
    own.write_text("a file in the way")
    server.answers = served("pinned", tiny_bace)
    with pytest.raises(PipelineError, match=r"(?s)cannot write .*XDG_DATA_HOME"):
        load_dataset("bace")


@pytest.mark.parametrize("layout", ["lcn/{}", "lcn/{}.gz", "{}", "{}.gz"])
def test_a_given_folder_may_be_plain_or_packed_and_nothing_is_fetched(server, tiny_bace, tmp_path, monkeypatch, layout):
    for path, content in tiny_bace.items():
        target = tmp_path / "given" / layout.format(path.removeprefix("lcn/"))
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(gzip.compress(content) if layout.endswith(".gz") else content)
    monkeypatch.setenv("OTR_DATA_DIR", str(tmp_path / "given"))
    assert load_dataset("bace").valid.Y.tolist() == [[1], [0]]
    assert locate(FILES[TRAIN]) == tmp_path / "given" / layout.format("bace_split/train.fgp2048.csv")
    assert server.asked == []


def test_a_given_folder_without_the_file_says_where_to_put_it(server, tiny_bace, tmp_path, monkeypatch):
    server.answers = served("pinned", tiny_bace)
    monkeypatch.setenv("OTR_DATA_DIR", str(tmp_path))
    with pytest.raises(MissingInputError) as caught:
        load_dataset("bace")
    assert_says_what_to_do(str(caught.value), tmp_path)
    assert server.asked == []


def test_a_given_folder_that_is_not_there(tmp_path, monkeypatch):
    monkeypatch.setenv("OTR_DATA_DIR", str(tmp_path / "nowhere"))
    with pytest.raises(ConfigError, match="nowhere: there is no such folder"):
        load_dataset("bace")


@pytest.mark.parametrize("damage", [lambda b: b[:-20], lambda b: b[:50] + b"!" + b[51:], lambda b: b"not gzip"])
def test_a_damaged_local_file_is_named_and_not_used(server, tiny_bace, own, damage):
    server.answers = served("pinned", tiny_bace)
    load_dataset("bace")
    kept = own / f"{TRAIN}.gz"
    kept.write_bytes(damage(kept.read_bytes()))
    with pytest.raises(PipelineError) as caught:
        load_dataset("bace")
    assert not isinstance(caught.value, MissingInputError)
    for part in (str(kept), "Delete it", FILES[TRAIN].addresses[0], FILES[TRAIN].git_blob):
        assert part in str(caught.value)


def test_a_relative_xdg_folder_is_ignored(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_DATA_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert download.own_folder() == tmp_path / ".local" / "share" / "otr"
