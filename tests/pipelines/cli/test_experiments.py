"""The sweeps of Table 4.1 and Figure 4.6: which jobs they have, in which order, and what words change of them."""

import pytest

from pipelines.cli.runs import RUN
from pipelines.errors import ConfigError
from tests.pipelines.conftest import otr_command


def jobs(*words):
    return [dict(word.lstrip("+").split("=", 1) for word in own) for own in RUN.expand([*words], False)]


def test_figure_4_6_is_swept_by_its_budget():
    thesis, quick, smoke = (jobs("+experiment=figure_4_6", f"budget={name}") for name in ("thesis", "quick", "smoke"))
    assert [len(thesis), len(quick), len(smoke)] == [4 * 9 * 3 * 15, 4 * 9 * 3 * 5, 3]
    assert [sorted(own.items()) for own in jobs("+experiment=figure_4_6")] == [sorted(own.items()) for own in thesis]
    assert list(dict.fromkeys(own["oracle"] for own in thesis)) == ["[32]", "[256]", "[64,64]", "[256,256]"]
    for swept in (thesis, quick):
        assert list(dict.fromkeys(own["depth"] for own in swept)) == [str(depth) for depth in range(2, 11)]
    assert {own["env"] for own in thesis} == {"lunarlander"}
    first, second = quick[:2]  # which two workers have first: of different oracles
    assert (first.pop("seed"), second["seed"]) == ("0", "1") and first.items() <= second.items()
    pid = [(own["env"], own["method"], own["seed"]) for own in jobs("+experiment=figure_4_4", "budget=quick")]
    assert pid == [("pendulum", "pid", str(seed)) for seed in range(5)]


def test_a_list_gets_through_the_sweep_as_an_oracle():
    words = ["+experiment=figure_4_6", "budget=quick", "method=viper", "depth=2", "seed=0", "oracle=[32],[8,8]"]
    runs = RUN.jobs(RUN.expand(words, False))
    assert [job.config.oracle for job in runs] == [[32], [8, 8]]
    folders = [f"runs/lunarlander/otr/depth-{depth}/quick/seed-0" for depth in ("32", "8-8")]
    assert [job.oracle.folder for job in runs] == folders
    assert runs[0].config.algo.critic == [128, 128]


def test_table_4_1_has_its_columns_and_no_others():
    own = jobs("+experiment=table_4_1")
    assert len(own) == 8 * 7 * 10
    assert list(dict.fromkeys((job["method"], job["depth"]) for job in own)) == [
        ("linear", "0"), ("viper", "6"), ("lm_viper", "6"), ("ndps", "6"), ("pi_prl", "6"), ("otr", "6"), ("otr", "32"),
    ]  # fmt: skip
    part = jobs("+experiment=table_4_1", "column=otr_32,pi_prl", "env=hopper", "seed=0")
    assert [tuple(job[key] for key in ("method", "depth", "env")) for job in part] == [
        ("otr", "32", "hopper"), ("pi_prl", "6", "hopper")]  # fmt: skip
    assert len(jobs("+experiment=table_4_1", "budget=smoke", "seed=0")) == 7
    assert jobs("env=hopper", "column=viper") == [{"env": "hopper", "method": "viper", "depth": "6"}]
    with pytest.raises(ConfigError, match=r"column=vipr: there is no such column\. Did you mean viper"):
        jobs("+experiment=table_4_1", "column=vipr")
    with pytest.raises(ConfigError, match=r"budget=fast: there is no such budget"):
        jobs("+experiment=figure_4_6", "budget=fast")


def test_plan_of_the_figure(tmp_path):
    words = ("+experiment=figure_4_6", "budget=quick", "method=augtree,viper", "depth=2")
    done = otr_command("otr-plan", *words, cwd=tmp_path, COLUMNS="300")
    assert "40 jobs: 0 to skip, 40 left" in done.stdout, done.stderr
    for widths in ("32", "256", "64-64", "256-256"):
        assert done.stdout.count(f"train oracle lunarlander/otr/depth-{widths}/quick/seed-") == 5
