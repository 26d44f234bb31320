"""What a page says first: what a policy returns, compared with its network, an oracle and a linear policy."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import otr
from otr.shorten.edits import n_numbers
from pipelines.config.run import RunConfig
from pipelines.engine.store import read_summary
from pipelines.errors import PipelineError
from pipelines.play.spaces import spaces
from pipelines.report.cells import METHOD_NAMES, run_in_words
from pipelines.report.headline import spread
from pipelines.report.statistics import welch_p_value
from pipelines.runs.finished_run import results_of, tree_of
from pipelines.runs.questions import number_of
from pipelines.runs.result import likeness, proof_line

ALPHA = 0.05  # of a difference that a page calls one
UNPROVED = {  # by whether the tree is a network's
    True: "Nothing is proved of it; certify=true tries.",
    False: "It was not made from a network that it could be proved equal to.",
}


@dataclass(frozen=True)
class Returns:
    """The mean and the deviation of a policy's returns over its evaluation episodes, and whose they are."""

    mean: float
    std: float
    n_episodes: int
    about: str = ""

    def __str__(self) -> str:
        return spread(self.mean, self.std)


def returns_of(summary: Mapping[str, Any], form: str, about: str = "") -> Returns | None:
    """Return what a form of a run's policy returns, from the run's summary; None where that does not know.

    A polished policy is the one that was pruned again; the minimal tree computes what the whole one does.
    """
    of_form = {"pruned": "pruned_tree", "full": "tree", "minimal": "tree"}.get(form, form)
    found = {"polished": summary.get("polish"), "simplified": summary.get("simplify")}.get(
        form, summary.get("policies", {}).get(of_form)
    )
    if not found:
        return None
    mean, std = (found.get(f"return_{name}_pruned", found.get(f"return_{name}")) for name in ("mean", "std"))
    return Returns(float(mean), float(std or 0.0), int(found["n_episodes"]), about)


def verdict(
    run: RunConfig,
    folder: Path,
    form: str,
    tree: otr.ObliqueTree,
    visited: NDArray[Any],
    certificate: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return what a page says of a run's tree before it shows it, as JSON-able data; `policy_data` has the arguments.

    Args:
        visited: states (n, d), on which a shorter program's actions are compared with those of the tree it shortens.

    Returns:
        `lead`: a sentence or two; `rows`: of each policy its name, its size and what it is, and its return;
        `lines`: how similarly it acts; `proof`; and the columns of the list of policies.
    """
    summary = read_summary(folder) | ({"certify": certificate} if certificate else {})
    own, numbers = returns_of(summary, form), n_numbers(tree)
    results_dir = results_of(folder)
    known = best_known(results_dir, run.env.name) if results_dir else {}
    widths = summary.get("oracle", {}).get("hidden_widths")
    oracle = returns_of(summary, "oracle", f"{network_in_words(widths)}, which this tree imitates") or known.get(
        "oracle"
    )
    others: list[tuple[str, Returns | None, int | None, int | None]] = []
    if form != "simplified" and (shorter := returns_of(summary, "simplified", "whose program is below")):
        others.append(("simplified", shorter, summary["simplify"]["n_leaves"], summary["simplify"]["n_numbers"]))
    if network := returns_of(summary, "network", "of which this is the tree"):
        others.append(("the network", network, None, None))
    elif form == "pruned" and summary["n_leaves"] != summary["pruned_leaves"]:
        others.append(("the whole tree", returns_of(summary, "full"), summary["n_leaves"], None))
    others += [("an oracle", oracle, None, None), ("a linear policy", known.get("linear"), None, None)]
    return {
        "lead": _lead(own, None if tree.n_nodes == 0 else known.get("linear")),
        "rows": [_row(*each, own.n_episodes if own else 0)
                 for each in ((f"this tree ({form})", own, tree.n_leaves, numbers), *others)],
        "lines": [*(_shortened(run, folder, summary, tree, visited) if form == "simplified" else []),
                  *_likeness(summary, form)],
        "proof": proof(summary, form),
        "proved": _proved(summary, form),
        "unproved": UNPROVED[run.method.is_mapped],
        "return": None if own is None else [own.mean, str(own)],
        "n_leaves": tree.n_leaves,
        "n_numbers": numbers,
    }  # fmt: skip


def _row(name: str, returns: Returns | None, n_leaves: int | None, numbers: int | None, n_episodes: int) -> list[str]:
    sizes = [number_of(n, what) for n, what in ((n_leaves, "leaf"), (numbers, "number")) if n is not None]
    if returns is None:
        return [name, ", ".join(sizes), "not run"]
    over = [] if returns.n_episodes == n_episodes else [f"over {returns.n_episodes:,} episodes"]
    return [name, ", ".join(filter(None, [*sizes, returns.about, *over])), str(returns)]


def _lead(own: Returns | None, linear: Returns | None) -> str:
    """Return what the policy returns, and whether that differs from what a linear one does (Welch's test)."""
    if own is None:
        return "This form of the tree has not been evaluated."
    text = f"Returns {own} over {own.n_episodes:,} episodes."
    if linear is None:
        return text
    p = welch_p_value((own.mean, own.std, own.n_episodes), (linear.mean, linear.std, linear.n_episodes))
    is_one = p < ALPHA if p == p else own.mean != linear.mean
    side = "higher than" if own.mean > linear.mean else "lower than"
    how = f"is {side}" if is_one else "does not differ significantly from"
    return f"{text} That {how} the best linear policy's {linear}: these two policies compared, not their methods."


def _likeness(summary: Mapping[str, Any], form: str) -> list[str]:
    lines = []
    if form == "pruned":
        policy, share = "network" if "network" in summary["policies"] else "whole tree", summary["fidelity"]
        lines.append(f"It acts as the {policy} in {math.floor(1e4 * share) / 100:.2f} % of the states that it visits.")
    if form == "polished":
        before = spread(*(summary["polish"][f"return_{name}_before"] for name in ("mean", "std")))
        lines.append(f"Before the polish it returned {before}.")
    if "oracle" in summary:
        lines.append(f"{likeness(summary['oracle']).capitalize()}.")
    return lines


def _shortened(
    run: RunConfig, folder: Path, summary: Mapping[str, Any], tree: otr.ObliqueTree, visited: NDArray[Any]
) -> list[str]:
    """Return how a shorter program acts compared with the tree that it shortens: labels alike, or actions apart."""
    form, box = "polished" if "polish" in summary else "pruned", spaces(run.env).box
    if box is None:
        alike = 100 * summary["simplify"]["fidelity"]
        return [f"It chooses as the {form} tree, which it shortens, in {alike:.1f} % of the states."]
    apart = np.abs(tree.predict(visited) - tree_of(form, run, folder).predict(visited)) / (box[1] - box[0])
    return [
        f"Its actions differ from those of the {form} tree, which it shortens, by {apart.mean():.1%} of their range on "
        f"average and {apart.max():.1%} at most, on {len(visited):,} states that it visits.".replace("%", " %")
    ]


def proof(summary: Mapping[str, Any], form: str) -> str:
    """Return what the run's certificate says, and that it is of the minimal tree; nothing where there is none."""
    if not summary.get("certify", {}).get("certified"):
        return ""
    text = proof_line(summary["certify"])
    if "polish" in summary and summary["certify"].get("policy") != "polished":
        text += ". It is of the network before the polish"
    if form == "simplified":
        return f"{text}. The tree below is a simplified one, another policy, of which nothing is proved."
    return text if form == "minimal" else f"{text}. The tree below is the {form} one."


def _proved(summary: Mapping[str, Any], form: str) -> str:
    """Return what is proved in a few words; "no" where the certificate is of another policy's network."""
    certificate, polished = summary.get("certify", {}), summary.get("polish", {}).get("kept", False)
    is_its = (certificate.get("policy") == "polished") == (form == "polished" and polished)
    if not certificate.get("certified") or form == "simplified" or not is_its:
        return "no"
    return f"its network's tree, {number_of(certificate['n_leaves'], 'leaf')}"


@functools.cache
def best_known(results_dir: Path, env: str) -> dict[str, Returns]:
    """Return the highest returns of an oracle and of a linear policy among an environment's runs, where there are any.

    A linear policy is one of depth 0, polished or not. A run whose summary cannot be read is ignored: it is not the
    one that is shown.
    """
    found: dict[str, list[Returns]] = {"oracle": [], "linear": []}
    for path in sorted((results_dir / "runs" / env).glob("*/depth-*/*/seed-*/summary.json")):
        try:
            summary = read_summary(path.parent)
        except PipelineError:
            continue
        method, depth, budget, seed = path.parts[-5:-1]
        where = run_in_words(budget, seed.removeprefix("seed-"))
        oracle = network_in_words(summary.get("oracle", {}).get("hidden_widths"))
        forms, name = [("oracle", "oracle", f"{oracle}, {where}")], METHOD_NAMES.get(method.replace("_", "-"), method)
        if depth == "depth-0":
            polished = [("polished", f"{name}, {where}, polished")] if summary.get("polish", {}).get("kept") else []
            forms += [("linear", *each) for each in (("pruned", f"{name}, {where}"), *polished)]
        for kind, form, about in forms:
            if returns := returns_of(summary, form, about):
                found[kind].append(returns)
    best = {kind: max(known, key=lambda each: each.mean) for kind, known in found.items() if known}
    n = {kind: len({each.mean for each in known}) for kind, known in found.items()}  # several imitate one oracle
    return {kind: replace(each, about=f"the best of {n[kind]:,} known: {each.about}") for kind, each in best.items()}


def network_in_words(widths: Sequence[int] | None) -> str:
    """Return an oracle's hidden layers in words: a network of two layers of 256."""
    if not widths:
        return "a linear policy" if widths is not None else "a policy"
    layers = {1: "one layer", 2: "two layers"}.get(len(widths), f"{len(widths)} layers")
    sizes = widths if len({*widths}) > 1 else widths[:1]
    return f"a network of {layers} of {' and '.join(map(str, sizes))}"
