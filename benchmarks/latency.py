"""Latency and size: a Hopper policy of depth 6 (11 inputs, 3 outputs) in C against Stable-Baselines3's `predict`.

Measured on the committed run `hopper/otr/depth-6/quick/seed-0`: its full tree of 64 leaves, the tree pruned to what the
policy reaches, and the compact form, the network itself with its neurons' rows shared. Each is written by `otr.to_c`,
compiled by the system's C compiler with -O2, and answers the states of 20 episodes of the policy, one call a state, in
a loop that the compiler cannot see into. Peer: `predict` of a SAC model with the same actor, one state a call, on the
same states. Sizes are what `size` counts of the object file, code and tables, with -Os, which is what a
microcontroller's build uses, and with -O2; the code is that of the machine that measures, and tanh is the library's.

Targets: at most 150 ns a state, and at least 500 times the calls per second of Stable-Baselines3; the compact form in
at most 2,048 bytes.
"""

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import otr
from benchmarks.measure import Entry, alternate
from benchmarks.peers import HOPPER, sac_with_actor
from pipelines.engine.archive import opened
from pipelines.play.actor_files import load_actor
from pipelines.play.episodes import play_seeds

RUN = Path(__file__).parent.parent / "results" / "runs" / "hopper" / "otr" / "depth-6" / "quick" / "seed-0"
DTYPES = {"double": np.float64, "float": np.float32}
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
N_EPISODES = 20
MAX_NS, MIN_RATIO, MAX_BYTES = 150, 500, 2048
# Reads states, answers all of them `passes` times, prints the least nanoseconds a state of several rounds, and writes
# the answers. The policy is in an object of its own, so that no call can be left out or merged with another.
DRIVER = """
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

void policy(const {dtype} x[{d}], {dtype} y[{o}]);

static double now(void)
{{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}}

int main(int argc, char **argv)
{{
    long n = argc == 6 ? atol(argv[1]) : 0, passes = n ? atol(argv[2]) : 0, rounds = n ? atol(argv[3]) : 0, i, p, r;
    {dtype} *x = malloc((size_t)n * {d} * sizeof *x), *y = malloc((size_t)n * {o} * sizeof *y);
    double least = 1e300;
    FILE *states = n ? fopen(argv[4], "rb") : NULL, *answers = n ? fopen(argv[5], "wb") : NULL;
    if (!x || !y || !states || !answers || fread(x, {d} * sizeof *x, (size_t)n, states) != (size_t)n)
        return 1;
    for (r = 0; r < rounds; r++) {{
        double began = now(), spent;
        for (p = 0; p < passes; p++)
            for (i = 0; i < n; i++)
                policy(x + i * {d}, y + i * {o});
        spent = (now() - began) / ((double)n * (double)passes);
        if (spent < least)
            least = spent;
    }}
    printf("%.6f\\n", least);
    return fwrite(y, {o} * sizeof *y, (size_t)n, answers) != (size_t)n || fclose(answers) != 0;
}}
"""


@dataclass(frozen=True)
class Form:
    """A form of the policy: its name, what `otr.to_c` is given, and its target for size."""

    name: str
    policy: Any
    target: str | None = None


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick has fewer rounds and episodes."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None or shutil.which("size") is None:
        print("latency: there is no C compiler or no `size` (binutils); nothing is measured", flush=True)
        return []
    network = load_actor(RUN / "train")
    with opened(RUN, ["prune"]) as whole:
        pruned = otr.load(whole / "prune" / "tree")
    forms = [
        Form("full tree, 64 leaves", otr.map_network(network)),
        Form("pruned tree", pruned),
        Form("compact form", network, f"value <= {MAX_BYTES}"),
    ]
    seeds = range(3 if quick else N_EPISODES)
    states = play_seeds(network.predict, HOPPER, seeds, keep_states=True, n_workers=1).states
    predict_s = _seconds_of_predict(network, states, rounds=3 if quick else 10)
    entries = []
    with tempfile.TemporaryDirectory() as folder:
        for form in forms:
            for dtype in DTYPES:
                entries += _times(form, dtype, states, predict_s, compiler, Path(folder), rounds=5 if quick else 30)
            print(f"latency: {form.name} timed", flush=True)
        for form in forms:
            for dtype in DTYPES:
                entries += _sizes(form, dtype, compiler, Path(folder))
    return entries


def _seconds_of_predict(network: otr.ReluNetwork, states: np.ndarray, rounds: int) -> float:
    """Return the seconds of Stable-Baselines3's `predict` on one state."""
    model = sac_with_actor(network)
    observations = list(states[:: max(1, len(states) // 200)])
    answers = model.predict(np.stack(observations), deterministic=True)[0]
    assert np.allclose(network.predict(np.stack(observations)), answers, atol=1e-5), "the SAC model has another actor"

    def predict() -> None:
        for observation in observations:
            model.predict(observation, deterministic=True)

    predict()
    return alternate(predict, rounds=rounds)[0] / len(observations)


def _times(
    form: Form, dtype: str, states: np.ndarray, predict_s: float, compiler: str, folder: Path, rounds: int
) -> list[Entry]:
    """Return the nanoseconds a state of one form, and its calls a second against those of `predict`."""
    ns, answers = run_compiled(form.policy, dtype, states, compiler, folder, rounds)
    expected = form.policy.predict(states.astype(DTYPES[dtype]))
    assert np.allclose(answers, expected, atol=1e-9 if dtype == "double" else 1e-3), f"{form.name}: other answers"
    name = f"one state, {form.name}, {dtype}"
    return [
        Entry(f"{name}: time", ns, "ns", target=f"value <= {MAX_NS}"),
        Entry(name, 1e9 / ns, "calls/s", "Stable-Baselines3 predict", 1 / predict_s, f"ratio >= {MIN_RATIO}"),
    ]


def run_compiled(
    policy: Any, dtype: str, states: np.ndarray, compiler: str, folder: Path, rounds: int
) -> tuple[float, np.ndarray]:
    """Return the least nanoseconds a state of a policy in C, and its answers (n, o)."""
    X = np.ascontiguousarray(states, dtype=DTYPES[dtype])
    (folder / "policy.c").write_text(otr.to_c(policy, dtype=dtype))
    (folder / "driver.c").write_text(DRIVER.format(dtype=dtype, d=X.shape[1], o=policy.n_outputs))
    X.tofile(folder / "states")
    sources = [str(folder / "policy.c"), str(folder / "driver.c")]
    _run([compiler, *WARNINGS, "-O2", "-fno-lto", *sources, "-lm", "-o", str(folder / "driver")])
    passes = max(1, 200_000 // len(X))
    arguments = [str(len(X)), str(passes), str(rounds), str(folder / "states"), str(folder / "answers")]
    ns = float(_run([str(folder / "driver"), *arguments]))
    return ns, np.fromfile(folder / "answers", dtype=DTYPES[dtype]).reshape(len(X), -1)


def _sizes(form: Form, dtype: str, compiler: str, folder: Path) -> list[Entry]:
    return [
        Entry(
            f"code and tables, {form.name}, {dtype}, {level}",
            size_bytes(otr.to_c(form.policy, dtype=dtype), level, compiler, folder),
            "bytes",
            target=form.target,
            clock=None,
        )
        for level in ("-Os", "-O2")
    ]


def size_bytes(source: str, level: str, compiler: str, folder: Path) -> int:
    """Return the bytes that `size` counts of a source's object file: code and constants, data, zeroed data."""
    (folder / "sized.c").write_text(source)
    _run([compiler, *WARNINGS, level, "-c", str(folder / "sized.c"), "-o", str(folder / "sized.o")])
    text, data, bss = (int(field) for field in _run(["size", str(folder / "sized.o")]).splitlines()[1].split()[:3])
    return text + data + bss


def _run(command: list[str]) -> str:
    """Return what a command prints; a failure shows what it complained of."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[:2])} ... failed with {done.returncode}:\n{done.stderr}")
    return done.stdout
