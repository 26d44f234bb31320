"""Named streams: distinct, reproducible, and never the reported episodes."""

from pipelines.engine.seeding import episode_seeds, evaluation_seeds, stream_seed


def test_streams_and_segments_differ_and_repeat():
    drawn = [stream_seed(seed, "train", segment) for seed in (0, 1) for segment in range(5)]
    drawn += [stream_seed(seed, name) for seed in (0, 1) for name in ("train", "selection", "prune")]
    assert len(set(drawn)) == 16
    assert stream_seed(3, "train", 2) == stream_seed(3, "train", 2)
    assert all(0 <= seed < 2**31 for seed in drawn)


def test_no_choice_is_made_on_reported_episodes():
    reported = set(evaluation_seeds(1000, 100))
    assert reported == set(range(1000, 1100))
    for seed in range(20):
        selection, prune = episode_seeds(seed, "selection", 10), episode_seeds(seed, "prune", 100)
        assert min(selection + prune) >= 2**20
        assert not (set(selection) & set(prune)) and not (reported & set(selection + prune))
        assert len(set(selection)) == 10
