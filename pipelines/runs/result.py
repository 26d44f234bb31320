"""What a finished run shows in a terminal: its returns, sizes and times, and its program when that is short."""

from pathlib import Path
from typing import Any

from rich.table import Table

import otr
from pipelines.config.env import EnvConfig
from pipelines.config.methods import METHODS
from pipelines.engine.command_text import command_text
from pipelines.engine.console import SHORT_PROGRAM, duration, show_finished
from pipelines.engine.store import read_csv
from pipelines.play.boxes import box_in_words
from pipelines.play.spaces import feature_names
from pipelines.runs.questions import bound_text, labels_but, number_of


def show_result(summary: dict[str, Any], run_dir: Path, whole: Path, env: EnvConfig) -> None:
    """Print the run's returns, sizes and times, where its artefacts are, and its program when that is short.

    The program is the polished tree's where polishing gained something, and the pruned tree's otherwise.
    `whole` is the folder with its unpacked stages.
    """
    last = "polish" if summary.get("polish", {}).get("kept") else "prune"
    program = whole / last / "program.txt"
    text = program.read_text(encoding="utf-8") if program.exists() else ""
    policy = "network" if "network" in summary["policies"] else "whole tree"
    paths = "activation pattern" if policy == "network" else "leaf"
    lines = [
        f"{number_of(summary['patterns'], paths)} reached, estimated pruned depth {summary['pruned_depth']:.1f}; "
        f"the pruned tree acts as the {policy} in {100 * summary['fidelity']:.2f} % of the states"
    ]
    lines += _fewer_answers(text, summary["pruned_leaves"])
    if "n_outside_domain" in summary:
        lines.append(
            f"{summary['n_outside_domain']:,} of {summary['n_states']:,} visited states lie outside the box in which "
            "the network is the trained policy, whose observations are clipped there"
        )
    if "oracle" in summary:
        lines.append(f"oracle {summary['oracle']['hidden_widths']}: {likeness(summary['oracle'])}")
    if "polish" in summary:
        lines.append(_polished(summary["polish"]))
    if "total_steps" in summary:
        lines.append(f"{summary['total_steps']:,} steps of the environment in all: {steps_in_words(summary)}")
    if "certify" in summary:
        lines.append(proof_line(summary["certify"], env))
    if "simplify" in summary:
        lines += _simplified(summary["simplify"], whole)
    if "leaves" in summary:
        lines.append(_returns_of_leaves(read_csv(whole / "leaves" / "returns.csv"), run_dir))
    if "video" in summary:
        lines.append(_shown(summary["video"], run_dir, whole))
    form = ["tree=polished"] if last == "polish" else []
    where = program if whole == run_dir else command_text("otr-export", [f"run={run_dir}", "format=text", *form])
    picture = run_dir / last / "tree.svg"
    show_finished(text, where, _title(summary), _table(summary), lines, summary["seconds"], run_dir, picture)


def result_row(summary: dict[str, Any]) -> dict[str, str]:
    """Return the columns of a sweep's table for a run: the returns of its tree, pruned and polished, and its leaves."""
    forms = {"tree": summary, **summary["policies"]} | ({"polished": summary["polish"]} if "polish" in summary else {})
    shown = {"tree": "return of the tree", "pruned_tree": "of the pruned tree", "polished": "polished"}
    returns = {what: _return(forms[form]) for form, what in shown.items() if form in forms}
    last = summary["polish"]["n_leaves"] if "polish" in summary else summary["pruned_leaves"]
    return {**returns, "leaves": f"{last:,}"}


def _return(moments: dict[str, Any]) -> str:
    return f"{moments['return_mean']:z.1f} ± {moments['return_std']:.1f}"


def _fewer_answers(program: str, n_leaves: int) -> list[str]:
    """Return why a program answers in fewer places than its tree has leaves, where it does."""
    n_answers = sum(line.strip().startswith("return") for line in program.splitlines())
    if not 0 < n_answers < n_leaves:
        return []
    return [
        f"the program writes {n_leaves:,} leaves as {n_answers}: tests whose two sides answer the same are left out"
    ]


def likeness(oracle: dict[str, Any]) -> str:
    """Return how similar the tree is to the oracle, as text."""
    if "equal_labels" in oracle:
        return (
            f"the tree chooses as the oracle does in {100 * oracle['equal_labels']:.1f} % of the states that it visits"
        )
    apart = f"{oracle['mean_difference']:.3g}"
    return f"the tree is {apart} from the oracle's actions on average, on the states that it visits"


def proof_line(report: dict[str, Any], env: EnvConfig | None = None) -> str:
    """Return what the certificate says, as text; of an environment with the sides of the box, by its names."""
    where = report["domain"]
    if env is not None:
        domain = otr.Domain.from_dict(report)
        where += f", {box_in_words(domain, feature_names(env, domain.n_inputs))}"
    if not report["certified"]:
        return f"no certificate on {where}: {report['reason']}"
    spent = sum(report["seconds"].values())
    leaves, error = number_of(report["n_leaves"], "leaf"), report["max_error"]
    network = "the polished network" if report.get("policy") == "polished" else "the network"
    if not error:
        like = f"exactly {network}"
    elif report.get("labels"):
        like = f"{network}, but perhaps {labels_but(error)},"
    else:
        like = f"{network} to {bound_text(error)}"
    beyond = (
        "; that box reaches beyond the one in which the network is the trained policy, whose observations are clipped"
        if "network_domain" in report
        else ""
    )
    return (
        f"certificate: the minimal tree, of {leaves}, is {like} on {where}, by rational arithmetic "
        f"({duration(spent)}); otr-verify checks it again{beyond}"
    )


def _polished(report: dict[str, Any]) -> str:
    """Return what polishing gained, as text."""
    if report["kept"]:
        outcome = (
            f"return {_before_and_after(report)} over {report['n_episodes']:,} other episodes"
            f" ({report['confirmation_return_before']:.1f} to {report['confirmation_return']:.1f} on the "
            f"{report['n_selection_episodes']:,} that confirmed it); the program is the polished tree's"
        )
    else:
        confirming = f"{report['n_selection_episodes']:,} other episodes"
        outcome = f"nothing better was confirmed on {confirming}; it stays as it was"
    spent = duration(report["cpu_seconds"])
    how = f"searched in {number_of(report['n_iterations'], 'iteration')}, {report['n_steps']:,} steps"
    if report.get("by") == "critic":
        how = (
            f"learnt by critics in {report['n_learning_steps']:,} steps after {report['n_refill_steps']:,} of play, "
            f"{report['n_steps']:,} with the episodes that chose"
        )
    return f"polished: {report['n_numbers']} numbers of the {report['numbers']} {how} ({spent}); {outcome}"


def steps_in_words(summary: dict[str, Any]) -> str:
    """Return the environment steps that a policy polished by critics has cost, its training's or its oracle's first."""
    imitation, polish = summary.get("imitate", {}).get("n_steps", 0), summary["polish"]
    had = "of the oracle" if "imitate" in summary else "of the training"
    actor = polish["n_refill_steps"] + polish["n_learning_steps"]
    parts = {had: summary["steps"], "of the imitation": imitation, "of the actor": actor}
    return ", ".join(f"{number:,} {what}" for what, number in parts.items() if number)


def _short_program(title: str, path: Path) -> list[str]:
    """Return a program under a title, where there is one and it is short."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return [f"\n{title}:\n\n{text}"] if 0 < text.count("\n") <= SHORT_PROGRAM else []


def _before_and_after(report: dict[str, Any]) -> str:
    """Return the returns on the evaluation episodes, as text."""
    before, after = (
        f"{report[f'return_mean{when}']:z.1f} ± {report[f'return_std{when}']:.1f}" for when in ("_before", "")
    )
    return f"{before} before and {after} after"


def _simplified(report: dict[str, Any], whole: Path) -> list[str]:
    """Return the shorter program, where it is short, and what it costs."""
    same, apart = 100 * report["fidelity"], report["mean_difference"]
    within = f", to {100 * report['fidelity_tolerance']:.0f} % of its range," if report["fidelity_tolerance"] else ""
    leaves = f"{number_of(report['n_leaves_before'], 'leaf')} to {report['n_leaves']}"
    again = report.get("polished_again")
    return [
        *_short_program("simplified", whole / "simplify" / "program.txt"),
        f"simplified: {report['n_numbers_before']} numbers to {report['n_numbers']}, {leaves}; over "
        f"{report['n_episodes']:,} other episodes {_before_and_after(report)}; the same action{within} in "
        f"{same:.1f} % of the states, {apart:.2g} apart on average",
        *([f"polished again: {again['return_mean_before']:z.1f} before and {report['return_mean']:z.1f} after"
           if again["kept"] else "polished again: nothing better was confirmed"] if again else []),
        *([_loss(report["loss"])] if "loss" in report else []),
    ]  # fmt: skip


def _loss(loss: dict[str, Any]) -> str:
    """Return what a shorter program loses against the one that it came from, as text."""
    mean, error = loss["mean"], loss["standard_error"]
    where = f"on {loss['n_episodes']:,} episodes that decided nothing"
    if mean > error:
        return f"the shorter program loses {mean:.2f} ± {error:.2f} {where}"
    return f"the shorter program loses nothing {where}: {-mean:+z.2f} ± {error:.2f}"


def _returns_of_leaves(rows: list[dict[str, str]], run_dir: Path) -> str:
    """Return what the policy returns with fewer leaves, and what draws that."""
    returns = ", ".join(f"{int(row['n_leaves']):,}: {float(row['return_mean']):z.1f}" for row in rows)
    return f"return by leaves kept: {returns}; {command_text('otr-tabulate', ['leaves', f'run={run_dir}'])}"


def _shown(report: dict[str, Any], run_dir: Path, whole: Path) -> str:
    """Return which episode a video shows, and where it is."""
    file = "video/episode.gif"
    where = f"{run_dir}/{file}" if whole == run_dir else f"in {run_dir}/stages.tar.xz: {file}"
    return f"video: the episode of seed {report['seed']}, return {report['return']:.1f}: {where}"


def _leaves(n_leaves: int) -> str:
    """Return a number of leaves in readable form: 64, or 2^32."""
    return f"{n_leaves:,}" if n_leaves <= 2**20 else f"2^{n_leaves.bit_length() - 1}"


def _title(summary: dict[str, Any]) -> str:
    """Return which run this is: its environment, method and depth, and how it was trained, or which program it is."""
    env_id = "" if summary["env_id"] == summary["env"] else f" ({summary['env_id']})"
    given = next((name for name in ("program", "model") if name in summary), "")
    method = "" if summary["method"] in ("otr", given) else f", {METHODS[summary['method']].label}"
    depth = str(summary["depth"]).strip("[]")
    start = f"{summary['env']}{env_id}{method}, depth {depth}"
    if given:
        budget = f" ({summary['budget']})" if method else ""
        return f"{start}{budget}, {given} {summary[given]}, seed {summary['seed']}"
    trainer = "" if summary["trainer"] == "sb3" else f", {summary['trainer']}"
    return (
        f"{start}, {summary['algorithm'].upper()}, {summary['steps']:,} steps ({summary['budget']}{trainer}), "
        f"seed {summary['seed']}"
    )


def _table(summary: dict[str, Any]) -> Table:
    episodes = summary["n_episodes"]
    table = Table()
    table.add_column("policy")
    table.add_column(f"return over {episodes:,} episodes", justify="right")
    table.add_column("leaves", justify="right")
    leaves = {"tree": _leaves(summary["n_leaves"]), "pruned_tree": f"{summary['pruned_leaves']:,}"}
    for name, moments in summary["policies"].items():
        table.add_row(name.replace("_", " "), _return(moments), leaves.get(name, ""))
    if "polish" in summary:
        polished = summary["polish"]
        table.add_row("polished", _return(polished), f"{polished['n_leaves']:,}")
    return table
