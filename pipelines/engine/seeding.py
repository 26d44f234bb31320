"""All randomness of a run comes from named streams of one SeedSequence; no two purposes share episodes.

Evaluation uses the fixed seeds `first_seed + i`, all below 2**20, the same for every method. What is selected, pruned
or searched plays episodes of seeds from 2**20 upwards, so that nothing is chosen on the episodes that are reported.
"""

import numpy as np

STREAMS = {"train": 0, "selection": 1, "prune": 2, "imitate": 3, "simplify": 4, "polish": 5}
FIRST_STREAM_SEED = 2**20
LAST_STREAM_SEED = 2**31 - 1


def stream(seed: int, name: str, *index: int) -> np.random.SeedSequence:
    """Return the named stream of the run with this seed; `index` picks an element of it, such as a segment."""
    return np.random.SeedSequence(seed, spawn_key=(STREAMS[name], *index))


def stream_seed(seed: int, name: str, *index: int) -> int:
    """Return one integer seed of a stream, for libraries that accept only integers."""
    return stream_seeds(1, seed, name, *index)[0]


def stream_seeds(n: int, seed: int, name: str, *index: int) -> list[int]:
    """Return n integer seeds of a stream; the first is `stream_seed`'s."""
    return [int(word >> 1) for word in stream(seed, name, *index).generate_state(n, np.uint32)]


def episode_seeds(seed: int, name: str, n_episodes: int, *index: int) -> list[int]:
    """Return `n_episodes` distinct reset seeds of a stream, or of the element `index` of it, all at least 2**20."""
    generator = np.random.default_rng(stream(seed, name, *index))
    start = int(generator.integers(FIRST_STREAM_SEED, LAST_STREAM_SEED - n_episodes))
    return list(range(start, start + n_episodes))


def evaluation_seeds(first_seed: int, n_episodes: int) -> list[int]:
    """Return the reported episodes' reset seeds, `first_seed` onwards."""
    return list(range(first_seed, first_seed + n_episodes))
