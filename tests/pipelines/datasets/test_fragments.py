"""What bits stand for: names for people, from the committed table."""

import pytest

from pipelines.datasets import fragment_names
from pipelines.errors import ConfigError


def test_names_for_people():
    names = fragment_names("bace")
    assert len(names) == len(set(names)) == 2048
    assert names[1057] == "[CH3] (bit1057)"
    assert names[15] == "bit15"  # in no molecule
    assert names[4] == "bit4"  # of two molecules, each has another fragment
    assert max(map(len, names)) == len("cccccccccccccccccccc (bit1234)")
    assert next(name for name in names if "…" in name).index("… (bit") == 19


def test_data_sets_without_a_table_keep_their_names(own):
    assert fragment_names("tox21")[-1] == "bit2047"  # the data set itself is not here
    assert fragment_names("diabetes")[:2] == ("age", "sex")
    with pytest.raises(ConfigError, match="Did you mean bace"):
        fragment_names("baze")
