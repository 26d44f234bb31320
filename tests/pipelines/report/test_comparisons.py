"""Policies beside their rivals, from made-up runs with known episodes."""

import numpy as np
import pytest

from pipelines.engine.store import read_csv
from pipelines.errors import PipelineError
from pipelines.report.comparisons import write_comparisons
from tests.pipelines.report.conftest import write_run

STARTS = range(1000, 1040)


def played(results_dir, run, shift, starts=STARTS, spread=0.0, form="evaluate"):
    """A run whose return from start s is s, and that much more; every second start that much besides."""
    returns = [s + shift + spread * (s % 2) for s in starts]
    path = results_dir / "runs" / run / "summary.json"
    if not path.exists():
        write_run(results_dir, run, float(np.mean(returns)), n_episodes=len(returns))
    folder = path.parent / form
    folder.mkdir()
    lines = ["episode,seed,return", *(f"{i},{s},{r}" for i, (s, r) in enumerate(zip(starts, returns, strict=True)))]
    (folder / "episodes.csv").write_text("\n".join(lines) + "\n")


def rows(results_dir):
    markdown, table = write_comparisons(results_dir)
    found = read_csv(table)
    first = {(r["method"], r["budget"], r["rival"]): r for r in reversed(found)}
    return markdown.read_text(), first | {(r["method"], r["budget"], r["rival"], r["rival_budget"]): r for r in found}


def test_a_policy_stands_beside_the_linear_row_and_otr(tmp_path):
    for seed in range(5):
        played(tmp_path, f"hopper/linear/depth-0/quick/seed-{seed}", 0.0 + seed)
        played(tmp_path, f"hopper/otr/depth-6/quick/seed-{seed}", 10.0 + seed, spread=1.0)
    played(tmp_path, "hopper/viper/depth-6/quick/seed-0", -5.0)
    markdown, found = rows(tmp_path)
    assert {key for key in found if len(key) == 3} == {
        ("otr", "quick", "linear"), ("viper", "quick", "linear"), ("viper", "quick", "otr"),
    }  # fmt: skip
    otr = found["otr", "quick", "linear"]
    assert (otr["n_runs"], otr["n_rival_runs"], otr["n_starts"]) == ("5", "5", "40")
    assert float(otr["difference"]) == pytest.approx(10.5) and float(otr["probability"]) == 1.0
    half = 2.0226909 * np.std([0.0, 1.0] * 20, ddof=1) / np.sqrt(40)
    assert (float(otr["starts_low"]), float(otr["starts_high"])) == pytest.approx((10.5 - half, 10.5 + half), abs=1e-5)
    assert float(otr["runs_low"]) < 10.5 < float(otr["runs_high"])
    viper = found["viper", "quick", "otr"]
    assert viper["runs_low"] == "" and float(viper["difference"]) == pytest.approx(-17.5)
    assert "## Hopper\n" in markdown and "| VIPER  | 6     |" in markdown and "| -17.5" in markdown


def test_a_rival_of_the_same_budget_is_taken_else_the_most_runs(tmp_path):
    played(tmp_path, "hopper/linear/depth-0/thesis/seed-0", 0.0)
    for seed in range(2):
        played(tmp_path, f"hopper/linear/depth-0/quick/seed-{seed}", 1.0)
    for budget in ("thesis", "standard-ars"):
        played(tmp_path, f"hopper/otr/depth-6/{budget}/seed-0", 5.0, starts=range(1010, 1050))
    _, found = rows(tmp_path)
    assert found["otr", "thesis", "linear"]["rival_budget"] == "thesis"
    other = found["otr", "standard-ars", "linear"]
    assert (other["rival_budget"], other["n_starts"], float(other["difference"])) == ("quick", "30", 4.0)


def test_forms_are_paired_where_some_runs_have_both(tmp_path):
    for seed in range(6):
        before, run = 100.0 * seed, f"hopper/otr/depth-6/quick/seed-{seed}"
        if seed == 0:
            played(tmp_path, run, before)
            continue
        after = before + 1.0 + seed % 2
        moments = {"return_mean": 1019.5 + after, "n_episodes": 40}
        write_run(tmp_path, run, 1019.5 + before, n_episodes=40, polish=moments)
        played(tmp_path, run, before)
        played(tmp_path, run, after, form="polish")
    polished = rows(tmp_path)[1]["otr-polished", "quick", "otr"]
    assert (polished["n_runs"], polished["n_rival_runs"], float(polished["probability"])) == ("5", "5", 1.0)
    assert float(polished["difference"]) == pytest.approx(1.6)
    half = 2.7764451 * np.std([2.0, 1.0, 2.0, 1.0, 2.0], ddof=1) / np.sqrt(5)
    interval = [float(polished[name]) for name in ("runs_low", "runs_high")]
    assert interval == pytest.approx([1.6 - half, 1.6 + half], abs=1e-5)


def test_a_polished_policy_stands_beside_the_polished_rival(tmp_path):
    shifts = {"linear/depth-0": (0, 2.0), "otr/depth-6": (3, 7.0), "otr/depth-32": (4, 11.0), "viper/depth-6": (1,)}
    for policy, (before, *after) in shifts.items():
        run = f"hopper/{policy}/quick/seed-0"
        moments = {"polish": {"return_mean": 1019.5 + after[0], "n_episodes": 40}} if after else {}
        write_run(tmp_path, run, 1019.5 + before, n_episodes=40, **moments)
        played(tmp_path, run, before)
        if after:
            played(tmp_path, run, after[0], form="polish")
    _, table = write_comparisons(tmp_path)
    differences = {(r["method"], r["depth"], r["rival"]): float(r["difference"]) for r in read_csv(table)}
    assert differences == {
        ("linear-polished", "0", "linear"): 2.0,
        ("otr", "6", "linear"): 3.0, ("otr", "32", "linear"): 4.0, ("otr", "32", "otr"): 1.0,
        ("otr-polished", "6", "linear-polished"): 5.0, ("otr-polished", "6", "otr"): 4.0,
        ("otr-polished", "32", "linear-polished"): 9.0, ("otr-polished", "32", "otr-polished"): 4.0,
        ("viper", "6", "linear"): 1.0, ("viper", "6", "otr"): -2.0,
    }  # fmt: skip


@pytest.mark.parametrize("text", ["episode,seed\n0,1000\n", "episode,seed,return\n0,1000,much\n"])
def test_episodes_that_cannot_be_read_are_named(tmp_path, text):
    assert "Nothing has been run yet that could be compared." in rows(tmp_path)[0]
    for run in ("hopper/linear/depth-0/quick/seed-0", "hopper/otr/depth-6/quick/seed-0"):
        played(tmp_path, run, 0.0)
    (tmp_path / "runs" / run / "evaluate/episodes.csv").write_text(text)
    with pytest.raises(PipelineError, match=r"seed-0/evaluate/episodes\.csv cannot be read"):
        write_comparisons(tmp_path)
