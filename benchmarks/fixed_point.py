"""Integers of 16 bits: the best committed tree of each environment, proved, played, and run on an AVR.

Of each environment the tree of 2 to 99 leaves, pruned or polished, with the highest evaluated return. It is rounded
over the environment's box of states or, where that is open or too wide for the target, the box around the states of 20
episodes of the floats. The proof is
that of `otr.certify_fixed_point` on the tree: the largest error of an action as a share of its range, at every real
state of the box but for those within a distance of the tree's tests. Integers and floats play the same 20 starts. Bytes
and cycles of a call are those of `benchmarks/microcontrollers.py`, on 1,000 states of the box, compared with plain
float C of the same policy, its network where it has one, else its tree, and of a network with emlearn's float C, where
that is installed (``pip install emlearn pybind11``). The table is results/tables/fixed_point.md.

Target: an error of at most 1 % of the range.
"""

import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import otr
from benchmarks.measure import Entry, output_dir, results_dir
from benchmarks.microcontrollers import TARGETS, Ran, Source, answers_hash, run_on
from pipelines.cli.runs import load_config
from pipelines.config.run import RunConfig
from pipelines.engine.store import read_summary, write_text
from pipelines.play.actor_files import load_actor
from pipelines.play.boxes import box_around
from pipelines.play.episodes import play_seeds
from pipelines.runs.finished_run import tree_of
from pipelines.runs.verify_run import wanted_box

EMLEARN = version("emlearn") if find_spec("emlearn") else ""
BITS, WIDER, MOST_LEAVES, MARGIN, TARGET = 16, 20, 99, 0.1, 0.01
SEEDS = range(90_000, 90_020)
MACHINES = ("AVR", "Cortex-M0")


@dataclass(frozen=True)
class Best:
    """The best tree of an environment: its run's folder, and which of the run's trees it is."""

    task: str
    folder: Path
    form: str
    n_leaves: int


@dataclass(frozen=True)
class Row:
    """What is known of a tree in integers; text in place of a number that is not there."""

    best: Best
    share: float | str  # proved
    wider: float | None  # with WIDER bits, where that is above the target
    distance: float
    integers: float
    floats: float
    box: str
    n_clamped: int
    machines: dict[str, list[Ran | str] | str]  # integers, floats and, of a network, emlearn's floats
    peer: str


def measure(quick: bool) -> list[Entry]:
    """Return the entries and write the table; quick takes two environments, and fewer episodes and states."""
    trees = best_trees(results_dir() / "runs")
    rows = []
    for best in trees[:2] if quick else trees:
        rows.append(_row(best, 2 if quick else len(SEEDS), 100 if quick else 1000))
        print(f"fixed_point: {best.task} done", flush=True)
    place = output_dir(quick) if quick else results_dir() / "tables"
    write_text(place / "fixed_point.md", table(rows))
    return [entry for row in rows for entry in _entries(row)]


def best_trees(runs: Path) -> list[Best]:
    """Return the best tree of each environment, in order of their names."""
    found: dict[str, tuple[float, Best]] = {}
    for path in sorted(runs.glob("*/*/depth-*/*/seed-*/summary.json")):
        summary = read_summary(path.parent)
        forms = [("pruned", summary["pruned_leaves"], summary["policies"].get("pruned_tree", {}).get("return_mean"))]
        polish = summary.get("polish", {})
        forms.append(("polished", polish.get("n_leaves"), polish.get("return_mean")))
        for form, n_leaves, mean in forms:
            if mean is None or not n_leaves or not 2 <= n_leaves <= MOST_LEAVES or summary["method"] == "pid":
                continue
            task = summary["task"]
            if task not in found or mean > found[task][0]:
                found[task] = mean, Best(task, path.parent, form, n_leaves)
    return [found[task][1] for task in sorted(found)]


def _row(best: Best, n_episodes: int, n_states: int) -> Row:
    run = load_config(best.folder, None)
    tree = tree_of(best.form, run, best.folder)
    seeds = SEEDS[:n_episodes]
    in_floats = play_seeds(tree.predict, run.env, seeds, keep_states=True, n_workers=1)
    wanted, visited = wanted_box(run), box_around(in_floats.states, MARGIN)
    boxes = [("visited", visited)] if wanted is None else [("declared", wanted[0]), ("visited", visited)]
    for kind, box in boxes:
        fixed = otr.to_fixed_point(tree, box, BITS)
        proof, name = otr.certify_fixed_point(fixed, tree, box), kind
        if proof.share is None or proof.share <= TARGET:
            break
    wider = None
    if proof.share is not None and proof.share > TARGET:
        longer = otr.to_fixed_point(tree, box, WIDER, accumulator_bits=64)
        wider = otr.certify_fixed_point(longer, tree, box).share
    in_integers = play_seeds(fixed.predict, run.env, seeds, keep_states=True, n_workers=1)
    states = in_integers.states
    n_clamped = int(((states < box.low) | (states > box.high)).any(axis=1).sum())
    sizes = np.sqrt((tree.P**2).sum(axis=1))
    with np.errstate(divide="ignore"):
        distance = float(np.max(np.array(proof.margins) / sizes, where=sizes > 0, initial=0.0))
    share = "same label" if fixed.head.gives_labels or fixed.labels is not None else proof.share
    network = _network(best, run)
    return Row(
        best,
        "not bounded: no limits" if share is None else share,
        wider,
        distance,
        float(np.mean(in_integers.returns)),
        float(np.mean(in_floats.returns)),
        name,
        n_clamped,
        dict(_machines(fixed, [tree if network is None else network, *emlearn_code(network, box)], n_states)),
        "tree" if network is None else "network",
    )


def _network(best: Best, run: RunConfig) -> Any:
    """Return the network of a mapped tree, else None."""
    if not run.method.is_mapped:
        return None
    stage = "polish" if best.form == "polished" else run.method.actor_stage
    return load_actor(best.folder / stage) if best.form == "pruned" else None


def _machines(
    fixed: otr.FixedPointTree, peers: list[Any], n_states: int
) -> Iterator[tuple[str, list[Ran | str] | str]]:
    for name in MACHINES:
        missing = TARGETS[name].missing()
        if missing:
            yield name, f"not run: no {missing}"
            continue
        ran: list[Ran | str] = []
        for policy in (None, *peers):
            with TemporaryDirectory() as folder:
                try:
                    ran.append(run_on(TARGETS[name], fixed, n_states, Path(folder), in_floats=policy))
                except RuntimeError as error:
                    if not any(words in str(error) for words in ("is too large", "not within region", "overflowed")):
                        raise
                    ran.append("does not fit")  # of plain C, an AVR holds constant tables in its RAM
        if isinstance(ran[0], Ran) and ran[0].hash != answers_hash(fixed, n_states):
            raise RuntimeError(f"{name}: the integers are not those of Python")
        if len({each.hash for each in ran[1:] if isinstance(each, Ran)}) > 1:
            raise RuntimeError(f"{name}: emlearn's C does not answer as plain C of the same network")
        yield name, ran


def emlearn_code(network: Any, box: otr.Domain) -> list[Source]:
    """Return emlearn's C of a network of one hidden layer, clipped as the policy is; nothing if not installed.

    Its layers read the layer before alone, by ReLU. So what the output reads of the inputs goes through d more units,
    ``relu(x - low)``, which is ``x - low`` in the box, and so does the slope of leaky units.
    """
    if not EMLEARN or network is None or len(network.weights) != 2:
        return []
    from emlearn import includedir, net

    (W, V), (b, c), slope = network.weights, network.biases, network.negative_slope
    d, o, n = network.n_inputs, network.n_outputs, len(network.biases[0])
    of_inputs = slope * V[:, :n] @ W + (V[:, n:] if network.dense else 0)
    weights, biases = [W, (1 - slope) * V[:, :n]], [b, c + slope * V[:, :n] @ b]
    if of_inputs.any():
        weights = [np.concatenate((W, np.eye(d))), np.column_stack((weights[1], of_inputs))]
        biases = [np.concatenate((b, -box.low)), biases[1] + of_inputs @ box.low]
    code = net.c_generate_net_loadable(["relu", "identity"], [each.T for each in weights], biases, prefix="net")
    limits = zip(("low", "high"), network.head.limits(o), strict=True)
    constants = [f"static const float {end}[] = {{ {', '.join(map(repr, side.tolist()))} }};" for end, side in limits]
    text = f"""{code}
{" ".join(constants)}
void policy(const float x[{d}], float y[{o}]);
void policy(const float x[{d}], float y[{o}])
{{
    int k;
    net_regress(x, {d}, y, {o});
    for (k = 0; k < {o}; k++)
        y[k] = y[k] < low[k] ? low[k] : y[k] > high[k] ? high[k] : y[k];
}}
"""
    return [Source(text, includedir)]


def _entries(row: Row) -> list[Entry]:
    task = row.best.task
    entries = [Entry(f"{task}: return of the integers", row.integers, "return", "floats", row.floats, clock=None)]
    if not isinstance(row.share, str):
        entries.append(
            Entry(f"{task}: proved error", row.share, "of the range", target=f"value <= {TARGET}", clock=None)
        )
    for name, ran in row.machines.items():
        if isinstance(ran, str):
            continue
        ours, theirs = ran[:2]
        for what, unit in (("n_bytes", "bytes"), ("mean", TARGETS[name].unit)):
            peer = None if isinstance(theirs, str) else getattr(theirs, what)
            entries.append(Entry(f"{task}: {name}, {unit}", getattr(ours, what), unit,
                                 None if peer is None else f"float C of the {row.peer}", peer, clock=None))  # fmt: skip
    return entries


def table(rows: list[Row]) -> str:
    """Return the table as Markdown."""
    heads = ["environment", "tree", "leaves", "box", "proved error", "return, integers", "return, floats"]
    heads += [f"{name}: {what}" for name in MACHINES for what in ("bytes", TARGETS[name].unit)]
    lines = ["# Trees in integers of 16 bits", "", *_notes(rows), "", f"| {' | '.join(heads)} |"]
    lines.append(f"| {' | '.join(['---'] * len(heads))} |")
    for row in rows:
        share = row.share if isinstance(row.share, str) else f"{row.share:.3%}"
        folder = "/".join(row.best.folder.parts[-4:])
        cells = [row.best.task, f"{row.best.form} of {folder}", str(row.best.n_leaves), row.box]
        share += "" if row.wider is None else f" ({WIDER} bits, sums of 64: {row.wider:.3%})"
        cells += [f"{share} beyond {row.distance:.1g}", f"{row.integers:,.1f}", f"{row.floats:,.1f}"]
        for ran in row.machines.values():
            cells += [ran, ran] if isinstance(ran, str) else [_compared(ran, what) for what in ("n_bytes", "mean")]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _compared(ran: list[Ran | str], what: str) -> str:
    ours, *peers = (each if isinstance(each, str) else f"{getattr(each, what):,}" for each in ran)
    return f"{ours} ({'; '.join(peers)})"


def _notes(rows: list[Row]) -> list[str]:
    clamped = ", ".join(f"{row.best.task} {row.n_clamped:,}" for row in rows if row.n_clamped)
    networks = ", ".join(row.best.task for row in rows if row.peer == "network")
    proved = f"""The proved error is the largest of any action at every real state of the box, as a share of the
        action's range, but for states within that distance (Euclidean, in the inputs) of a test, whose other side may
        answer. The box is the one that the environment declares or, where that is open or no 1 % is proved on it, the
        one around the states of 20 episodes. States beyond the box, which are clamped: {clamped or "none"}."""
    peer = f"then emlearn {EMLEARN}'s float C of the network" if EMLEARN else "emlearn was not run, as not installed"
    machines = f"""Bytes are code and tables with all that is linked for them; cycles (of the Cortex-M0 instructions:
        QEMU counts no cycles) the mean of a call. In brackets plain float C of the network ({networks or "none"}) or of
        the same tree, whose tables an AVR holds in its 16 KB of RAM; {peer}. It has no trees
        with oblique tests, its networks in fixed point are a stub (``eml_net_fixedpoint.h``), and it reads no dense
        links or leaky units: hence more units."""
    notes = [proved, "Returns are means over the same 20 starts.", machines]
    wrapped = [textwrap.fill(" ".join(f"* {note}".split()), 120, subsequent_indent="  ") for note in notes]
    return ["`python -m benchmarks fixed_point` writes this table: the best committed tree of 2 to 99 leaves, with",
            "coefficients, inputs and answers of at most 16 bits and sums of 32.", "", *wrapped]  # fmt: skip
