"""Direct search (algo=ars): environment steps a CPU-second, and what a return costs compared with SAC.

The whole search is `PolicySearch.iterate`: candidates, their episodes, the moments of their states, the step. Its
environments have twins that start the same episodes and do every step with the same actions right before or
after them. So the environments alone play episodes of the same lengths, as few at a time as are left, and a machine
that is slower for a while is slower for both. Measured after so many steps of search that the hopper and the
walker stand. The round with the median share counts.

The peer is sb3-contrib's ARS, as its documentation uses it: a linear policy, one environment, states as they are. It
has the same directions, step and noise. Both train from the start, in turns, without evaluations, for the 300,000 steps
of budget=quick; all turns count. The environments alone, which both have, take more than a third of the peer's time.

The picture, search.png and search.svg, has the returns that the committed runs of Hopper at depth 6 reached by search,
by Stable-Baselines3's SAC and by the fleet (`benchmarks/search_curves.py`). Their CPU-seconds are their steps at the
rates that are measured here in turns, because the runs were made on machines that did other things, too.

Targets: 0.85 of the environments alone; 2 times sb3-contrib's ARS.
"""

import time
from collections.abc import Callable, Sequence
from statistics import median, median_low
from unittest.mock import patch

import numpy as np
from sb3_contrib import ARS

from benchmarks.fleet import fleet_rate, peer_rate
from benchmarks.measure import Entry, output_dir, results_dir
from benchmarks.peers import HOPPER
from benchmarks.search_curves import PEERS, RATES, write_picture
from otr.control.environments import Stepped
from pipelines.cli import runs
from pipelines.config.algo import ArsConfig
from pipelines.config.env import EnvConfig
from pipelines.config.run import RunConfig
from pipelines.play.environments import make_env
from pipelines.play.episodes import Player
from pipelines.play.vector_envs import make_vector_env
from pipelines.training.search.policy_search import PolicySearch

WARM_UP_STEPS = {"hopper": 130_000, "walker2d": 300_000, "halfcheetah": 30_000}
WHOLE = 1.0  # as at the end of a search, whose episodes are whole ones

Rate = Callable[[], float]


def measure(quick: bool) -> list[Entry]:
    """Return the entries and write the picture; quick searches Hopper alone, and from its start."""
    entries = []
    for name, n_steps in WARM_UP_STEPS.items():
        if quick and name != "hopper":
            continue
        config = search_config(name)
        state = warmed_up(config, 2_000 if quick else n_steps)
        entries.append(share_of_environments(config, state, n_rounds=2 if quick else 7))
        print(f"search: {name} done", flush=True)
    entries.append(against_peer(1_000 if quick else 5_000, n_turns=2 if quick else 60))
    rates = rates_in_turns(2_000 if quick else WARM_UP_STEPS["hopper"], n_turns=1 if quick else 5)
    entries += [Entry(RATES, rates["ars"], "steps/s", peer, rates[trainer]) for trainer, peer in PEERS.items()]
    write_picture(results_dir(), rates, output_dir(quick))
    return entries


def search_config(env: str, *overrides: str) -> RunConfig:
    """Return the configuration of `otr-run env=... algo=ars`, at depth 6 unless overrides set it."""
    return runs.run_config([f"env={env}", *(overrides or ("depth=6",)), "algo=ars"])


def _episodes(config: RunConfig) -> Player:
    assert isinstance(config.algo, ArsConfig)
    return Player(config.env, config.algo.environments)


def warmed_up(config: RunConfig, n_steps: int) -> dict[str, np.ndarray]:
    """Return the state of the run's search after so many steps."""
    search, episodes = PolicySearch(config, 0), _episodes(config)
    while search.n_steps < n_steps:
        search.iterate(episodes, WHOLE)
    episodes.close()
    return search.state()


class TwinEnv:
    """Environments (`VectorEnv`) with a twin that does the same, whose CPU-seconds are counted."""

    def __init__(self, env: EnvConfig) -> None:
        self.twin_seconds = 0.0
        self._envs, self._twin = (make_vector_env(env, "gymnasium") for _ in range(2))
        self._twin_first = False

    def reset(self, seeds: Sequence[int] | None, envs: np.ndarray | None = None) -> np.ndarray:
        began = time.process_time()
        self._twin.reset(seeds, envs)
        self.twin_seconds += time.process_time() - began
        return self._envs.reset(seeds, envs)

    def step(self, actions: np.ndarray, envs: np.ndarray | None = None) -> Stepped:
        self._twin_first = not self._twin_first  # the second of the two finds warmer caches
        if self._twin_first:
            self._step_twin(actions, envs)
            return self._envs.step(actions, envs)
        outcome = self._envs.step(actions, envs)
        self._step_twin(actions, envs)
        return outcome

    def _step_twin(self, actions: np.ndarray, envs: np.ndarray | None) -> None:
        began = time.process_time()
        self._twin.step(actions, envs)
        self.twin_seconds += time.process_time() - began

    def close(self) -> None:
        self._envs.close()
        self._twin.close()


def share_of_environments(config: RunConfig, state: dict[str, np.ndarray], n_rounds: int) -> Entry:
    """Return the search's steps a second compared with those of its environments alone, an iteration a round."""
    search, twins = PolicySearch(config, 0), TwinEnv(config.env)
    search.restore(state)
    with patch("pipelines.play.episodes.make_vector_env", lambda *_: twins):
        episodes = _episodes(config)
    measured = []
    for _ in range(n_rounds):
        twins.twin_seconds, began = 0.0, time.process_time()
        n_steps = search.iterate(episodes, WHOLE).lengths.sum()
        seconds = time.process_time() - began - twins.twin_seconds
        measured.append((twins.twin_seconds / seconds, n_steps / seconds, n_steps / twins.twin_seconds))
    episodes.close()
    share = median_low(share for share, _, _ in measured)
    _, ours, alone = next(each for each in measured if each[0] == share)
    name = f"{config.env.id}: whole search from step {int(state['n_steps']):,}"
    return Entry(name, ours, "steps/s", "environments alone", alone, "ratio >= 0.85")


def against_peer(n_steps: int, n_turns: int) -> Entry:
    """Return a linear search's steps a second compared with sb3-contrib's, in turns of about `n_steps` steps."""
    config = search_config("hopper", "depth=0", "method=linear")
    sides = {"ours": search_turn(config, n_steps), "peer": peer_turn(config, n_steps)}
    n_done, seconds = dict.fromkeys(sides, 0), dict.fromkeys(sides, 0.0)
    for _ in range(n_turns):
        for side, turn in sides.items():
            began = time.process_time()
            n_done[side] += turn()
            seconds[side] += time.process_time() - began
    rates = {side: n_done[side] / seconds[side] for side in sides}
    name = f"Hopper-v4, linear, first {n_turns * n_steps:,} steps"
    return Entry(name, rates["ours"], "steps/s", "sb3-contrib's ARS", rates["peer"], "ratio >= 2")


def search_turn(config: RunConfig, n_steps: int, state: dict[str, np.ndarray] | None = None) -> Callable[[], int]:
    """Return a function that searches on for at least `n_steps` steps and returns how many it did."""
    search, episodes = PolicySearch(config, 0), _episodes(config)
    if state:
        search.restore(state)

    def turn() -> int:
        start = search.n_steps
        while search.n_steps < start + n_steps:
            search.iterate(episodes, WHOLE)
        return search.n_steps - start

    return turn


def peer_turn(config: RunConfig, n_steps: int) -> Callable[[], int]:
    """Return the same for sb3-contrib's ARS."""
    algo = config.algo
    assert isinstance(algo, ArsConfig)
    model = ARS(
        "LinearPolicy",
        make_env(HOPPER),
        n_delta=algo.n_directions,
        n_top=algo.n_top,
        learning_rate=algo.step_size,
        delta_std=algo.noise,
        alive_bonus_offset=-algo.alive_bonus,
        device="cpu",
        seed=0,
    )

    def turn() -> int:
        start: int = model.num_timesteps
        model.learn(n_steps, log_interval=None, reset_num_timesteps=False)
        return model.num_timesteps - start

    return turn


def rates_in_turns(warm_up_steps: int, n_turns: int) -> dict[str, float]:
    """Return environment steps a CPU-second of training a run of Hopper at depth 6, by who trains it."""
    config = search_config("hopper")
    turn = search_turn(config, 1_000, warmed_up(config, warm_up_steps))
    sides: dict[str, Rate] = {
        "ars": lambda: _rate(turn),
        "sb3": peer_rate(150),
        "fleet": fleet_rate(150),
    }
    measured: dict[str, list[float]] = {name: [] for name in sides}
    for i in range(n_turns):
        for name, side in sides.items():
            measured[name].append(side())
        rates = ", ".join(f"{name} {rates[-1]:,.0f}" for name, rates in measured.items())
        print(f"search: turn {i + 1} of {n_turns}, steps/s: {rates}", flush=True)
    return {name: median(rates) for name, rates in measured.items()}


def _rate(turn: Callable[[], int]) -> float:
    began = time.process_time()
    n_steps = turn()
    return n_steps / (time.process_time() - began)
