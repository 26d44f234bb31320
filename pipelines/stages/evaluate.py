"""Stage evaluate: network, tree and pruned tree on the same fixed episodes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import otr
from pipelines.config.method import MethodConfig
from pipelines.engine.stage import Inputs, Stage, picked
from pipelines.engine.store import write_csv, write_json
from pipelines.errors import PolicyMismatchError
from pipelines.play.actor_files import load_actor
from pipelines.play.agreement import answers_agree
from pipelines.play.episodes import PlaysEvaluation, Rollout, episodes_version, moments, play_each
from pipelines.stages.oracle import load_oracle

EPISODE_COLUMNS = ("episode", "seed", "return", "length", "terminated", "truncated")


@dataclass(frozen=True)
class EvaluateSettings(PlaysEvaluation):
    """What the stage reads of a run's configuration."""

    method: MethodConfig
    results_dir: str


def episodes_file(form: str) -> str:
    """Return the name of the file of a form's episodes."""
    return "episodes.csv" if form == "tree" else f"episodes_{form}.csv"


def load_policies(inputs: Inputs, settings: EvaluateSettings, *, tree: bool = True) -> dict[str, Any]:
    """Return the forms of the policy that a run left: what the tree represents, the tree and the pruned tree.

    The first is the oracle where one was imitated, the actor's network where it was mapped, and the soft tree where
    that was hardened; the latter's authors' own discretisation comes last, as does a PID policy's tree with its leaves'
    gains averaged. A program's tree represents nothing else. Without `tree` there is the pruned one alone.
    """
    policies: dict[str, Any] = {}
    if "soft" in settings.method.forms:
        from pipelines.training.soft_trees import SoftPolicy, load_soft  # imports torch

        hard: Any = otr.load(inputs["harden"] / "tree")
        policies["soft"] = SoftPolicy(load_soft(inputs["train"]), hard.head)
    if "oracle" in inputs:
        policies["oracle"] = load_oracle(inputs["oracle"], Path(settings.results_dir))
    if "map" in inputs:
        policies["network"] = load_actor(inputs[settings.method.actor_stage])
    if tree:
        policies["tree"] = otr.load(inputs[settings.method.tree_stage] / "tree")
    policies["pruned_tree"] = otr.load(inputs["prune"] / "tree")
    if (inputs["prune"] / "constant_gains.json").is_file():
        policies["constant_gains"] = otr.load(inputs["prune"] / "constant_gains")
    if "harden" in inputs and (inputs["harden"] / "discretised.json").is_file():
        policies["discretised"] = otr.load(inputs["harden"] / "discretised")
    return policies


def evaluate(inputs: Inputs, settings: EvaluateSettings, out: Path) -> None:
    """Play the fixed episodes with each form of the policy; write an episodes file each and `report.json`.

    `episodes.csv` is the tree's. Fidelity is the share of the visited states in which the pruned tree does the same as
    the policy that it was pruned from: the network, or the tree where there is none. Of a network that equals its
    policy on a domain only, the visited states outside that are counted.

    Raises:
        PolicyMismatchError: network and tree act differently in a state; the message shows it.
    """
    policies = load_policies(inputs, settings)
    whole = "network" if "network" in policies else "tree"
    played = play_each(policies, settings)
    states = played[whole].states
    answers, outputs = policies[whole].predict(states), policies[whole].forward(states)
    if whole == "network":
        _require_agreement(states, answers, policies["tree"].predict(states), outputs)
    alike = answers_agree(answers, policies["pruned_tree"].predict(states), outputs)
    for name, result in played.items():
        write_csv(out / episodes_file(name), episode_rows(result), EPISODE_COLUMNS)
    report = {
        "fidelity": float(alike.mean()),
        "n_states": len(states),
        "policies": {name: moments(own) | {"n_episodes": len(own.seeds)} for name, own in played.items()},
    }
    if "oracle" in policies:
        report["oracle"] = likeness(answers, policies["oracle"].predict(states))
    domain = getattr(policies[whole], "domain", None)
    if domain is not None:
        report["n_outside_domain"] = int((~domain.contains(states)).sum())
    write_json(out / "report.json", report)


def likeness(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """Return how like an oracle's the answers are: the share of equal labels, or the mean absolute difference."""
    if ours.ndim == 1:
        return {"equal_labels": float((ours == theirs).mean())}
    return {"mean_difference": float(np.abs(ours - theirs).mean())}


def episode_rows(played: Rollout) -> list[dict[str, Any]]:
    """Return the rows of an episodes file."""
    columns = (played.seeds, played.returns, played.lengths, played.terminated, played.truncated)
    rows = zip(range(len(played.seeds)), *(column.tolist() for column in columns), strict=True)
    return [dict(zip(EPISODE_COLUMNS, row, strict=True)) for row in rows]


def _require_agreement(states: np.ndarray, network: np.ndarray, tree: np.ndarray, outputs: np.ndarray) -> None:
    agreement = answers_agree(network, tree, outputs)
    if not agreement.all():
        i = int(np.flatnonzero(~agreement)[0])
        raise PolicyMismatchError(
            f"network and tree differ in {np.count_nonzero(~agreement)} of {len(states)} states; the first is "
            f"{states[i].tolist()}: the network does {network[i].tolist()}, the tree {tree[i].tolist()}"
        )


# Its inputs depend on the method: `pipelines.runs.stage_table.stages_of` sets them.
EVALUATE_KEYS = picked(env="env", n_episodes="evaluate.n_episodes", first_seed="evaluate.first_seed")
EVALUATE = Stage(
    "evaluate", version=episodes_version, inputs=(), keyed=EVALUATE_KEYS, run=evaluate, settings=EvaluateSettings
)
