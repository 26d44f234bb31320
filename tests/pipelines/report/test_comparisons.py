"""Which rival a policy is compared with; what is computed, the committed tables show (tests/test_results.py)."""

import numpy as np
import pytest

from pipelines.engine.store import read_csv
from pipelines.errors import PipelineError
from pipelines.report.comparisons import write_comparisons
from tests.pipelines.report.conftest import write_run

STARTS = range(1000, 1040)


def played(results_dir, run, shift, starts=STARTS):
    """A run whose return from start s is s, and that much more."""
    returns = [s + shift for s in starts]
    folder = write_run(results_dir, run, float(np.mean(returns)), n_episodes=len(returns)).with_name("evaluate")
    folder.mkdir()
    lines = ["episode,seed,return", *(f"{i},{s},{r}" for i, (s, r) in enumerate(zip(starts, returns, strict=True)))]
    (folder / "episodes.csv").write_text("\n".join(lines) + "\n")


def test_a_rival_of_the_same_budget_is_taken_else_the_most_runs(tmp_path):
    played(tmp_path, "hopper/linear/depth-0/thesis/seed-0", 0.0)
    for seed in range(2):
        played(tmp_path, f"hopper/linear/depth-0/quick/seed-{seed}", 1.0)
    for budget in ("thesis", "standard-ars"):
        played(tmp_path, f"hopper/otr/depth-6/{budget}/seed-0", 5.0, starts=range(1010, 1050))
    found = {(row["budget"], row["rival"]): row for row in reversed(read_csv(write_comparisons(tmp_path)[1]))}
    assert found["thesis", "linear"]["rival_budget"] == "thesis"
    other = found["standard-ars", "linear"]
    assert (other["rival_budget"], other["n_starts"], float(other["difference"])) == ("quick", "30", 4.0)


@pytest.mark.parametrize("text", ["episode,seed\n0,1000\n", "episode,seed,return\n0,1000,much\n"])
def test_episodes_that_cannot_be_read_are_named(tmp_path, text):
    assert "Nothing has been run yet that could be compared." in write_comparisons(tmp_path)[0].read_text()
    for run in ("hopper/linear/depth-0/quick/seed-0", "hopper/otr/depth-6/quick/seed-0"):
        played(tmp_path, run, 0.0)
    (tmp_path / "runs" / run / "evaluate/episodes.csv").write_text(text)
    with pytest.raises(PipelineError, match=r"seed-0/evaluate/episodes\.csv cannot be read"):
        write_comparisons(tmp_path)
