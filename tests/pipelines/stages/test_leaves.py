"""Stage leaves: which leaves are kept, on which episodes they are judged, and what a run shows of it."""

import numpy as np
import pytest

import otr
from pipelines.config.stages import EvaluateConfig, PruneConfig
from pipelines.engine.seeding import episode_seeds
from pipelines.engine.store import read_csv, read_json
from pipelines.play.actor_files import load_actor
from pipelines.play.episodes import play_seeds
from pipelines.runs.result import _returns_of_leaves
from pipelines.stages.leaves import leaves, numbers_of_leaves
from tests.committed import RESULTS
from tests.pipelines.conftest import PENDULUM

RUN = RESULTS / "runs/pendulum/otr/depth-6/quick/seed-0"


def test_numbers_of_leaves_are_powers_of_two_and_all() -> None:
    assert [list(numbers_of_leaves(n)) for n in (1, 2, 5, 8)] == [[1], [1, 2], [1, 2, 4, 5], [1, 2, 4, 8]]


def test_each_point_is_the_tree_of_the_most_visited_paths_on_the_evaluation_episodes(tiny, tmp_path) -> None:  # type: ignore[no-untyped-def]
    config = tiny(prune=PruneConfig(4, None), evaluate=EvaluateConfig(3, 1000))
    network = load_actor(RUN / "train")
    seeds = episode_seeds(config.seed, "prune", 4)
    states = play_seeds(network.predict, PENDULUM, seeds, keep_states=True, n_workers=1).states
    otr.save(otr.prune_unreached(otr.map_network(network), states), tmp_path / "tree")
    leaves({"prune": tmp_path}, config, tmp_path)

    rows = read_csv(tmp_path / "returns.csv")
    counts = np.sort(otr.PatternTree(network).observe(states).counts)[::-1]
    assert read_json(tmp_path / "report.json") == {"n_reached": len(counts), "n_states": len(states)}
    assert [int(row["n_leaves"]) for row in rows] == list(numbers_of_leaves(len(counts)))
    for row in rows:
        k = int(row["n_leaves"])
        kept = otr.prune_to_k(otr.PatternTree(network), states, k)
        expected = play_seeds(kept.predict, PENDULUM, range(1000, 1003), n_workers=1).returns
        assert float(row["return_mean"]) == pytest.approx(expected.mean(), rel=1e-6)
        assert float(row["share_of_states"]) == pytest.approx(counts[:k].sum() / len(states))
        assert int(row["n_episodes"]) == 3
    returns = [float(row["return_mean"]) for row in rows]
    assert returns[0] < -500 < returns[-1]
    assert _returns_of_leaves(rows, RUN).startswith(f"return by leaves kept: 1: {returns[0]:.1f}, 2: ")
