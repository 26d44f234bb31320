"""Stage certify: the minimal tree of a mapped actor on its environment's states, and the proof that it is exact."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import otr
from pipelines.config.method import MethodConfig
from pipelines.config.stages import CertificationConfig
from pipelines.engine.stage import Inputs, Stage, picked
from pipelines.engine.store import write_json
from pipelines.play.actor_files import load_actor
from pipelines.play.boxes import box_around, given_box
from pipelines.play.episodes import PlaysPruning, play_pruning
from pipelines.play.printed_programs import and_names, write_program
from pipelines.play.spaces import spaces, state_limits

MARGIN = 0.05  # of the width of what was visited, on either side
GIVEN = "the given box"


@dataclass(frozen=True)
class CertifySettings(PlaysPruning):
    """What the stage reads of a run's configuration."""

    method: MethodConfig
    certification: CertificationConfig


def certify(inputs: Inputs, settings: CertifySettings, out: Path) -> None:
    """Write the minimal tree, its `program.txt`, `certificate.json` and `report.json`.

    The domain is the box that is given or, without one, the box of states that the environment declares (gymnasium's
    observation space, which not every environment keeps to) where that is bounded, else the box around the states of
    the pruning episodes and 5 % more on either side. Where that reaches beyond the network's own domain, in which it is
    the policy that was trained (`from_sb3`), the report has that, too. The report says where a tree or a proof would
    be too large, or take too long. After polish=true the actor is the polished one.
    """
    network = load_actor(inputs.get("polish") or inputs[settings.method.actor_stage])
    domain, whence = _domain(inputs, settings)
    report: dict[str, Any] = (
        {"domain": whence} | domain.to_dict() | ({"policy": "polished"} if "polish" in inputs else {})
    )
    own = network.domain if "polish" not in inputs else None
    if own is not None and not own.contains([domain.low, domain.high]).all():
        report["network_domain"] = own.to_dict()  # which the domain reaches beyond
    limits = settings.certification
    began = time.monotonic()
    try:
        tree = otr.minimal_tree(
            network, domain, order="balanced", max_leaves=limits.max_leaves, max_seconds=limits.max_seconds
        )
        built = time.monotonic()
        certificate = otr.certify(tree, network, domain, max_seconds=limits.max_seconds)
        certified = time.monotonic()
        otr.verify(certificate, tree, network, max_seconds=limits.max_seconds)
        verified = time.monotonic()
    except otr.TreeTooLargeError as error:
        write_json(out / "report.json", {"certified": False, "reason": str(error)} | report)
        return
    otr.save(tree, out / "tree")
    write_program(tree, settings.env, out)
    certificate.save(out / "certificate.json")
    write_json(
        out / "report.json",
        {
            "certified": True,
            "max_error": certificate.max_error,
            **({} if tree.labels is None else {"labels": True}),
            "n_leaves": tree.n_leaves,
            "depth": tree.depth,
            "n_regions": certificate.n_regions,
            "n_linear_programs": certificate.n_linear_programs,
            **report,
            "seconds": {
                "minimal_tree": round(built - began, 3),
                "certify": round(certified - built, 3),
                "verify": round(verified - certified, 3),
            },
        },
    )


def _domain(inputs: Inputs, settings: CertifySettings) -> tuple[otr.Domain, str]:
    """Return the box on which the tree is proved, and what it is."""
    if settings.certification.box is not None:
        return given_box(settings.env, settings.certification.box), GIVEN
    limits = state_limits(settings.env)
    if limits is not None:
        return otr.Domain(*limits), "the environment's box of states"
    policy: Any = load_actor(inputs["polish"]) if "polish" in inputs else otr.load(inputs["map"] / "tree")
    return box_around(
        play_pruning(policy.predict, settings).states, MARGIN
    ), f"the box around the states of {settings.prune.n_episodes} episodes"


_USUAL = picked(
    env="env", n_episodes="prune.n_episodes", seed="seed", max_leaves="certification.max_leaves",
    max_seconds="certification.max_seconds"
)  # fmt: skip


def _keyed(settings: CertifySettings) -> dict[str, Any]:
    """Return the settings of a certificate; the box only where one is given, as certificates are older than it."""
    box = settings.certification.box
    return _USUAL(settings) | ({} if box is None else {"box": list(box)})


def _version(settings: CertifySettings) -> int:
    """Return 3 for labels, whose proofs lead to where the network has them, else 2."""
    return 3 if spaces(settings.env).box is None else 2


# Its inputs depend on the method and on polish=true: `pipelines.runs.stage_table.stages_of` sets them.
CERTIFY = Stage("certify", version=_version, inputs=(), keyed=and_names(_keyed), run=certify, settings=CertifySettings)
