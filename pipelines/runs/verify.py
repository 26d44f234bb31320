"""Certificates of finished runs, checked again without a solver."""

from dataclasses import dataclass
from pathlib import Path

import otr
from pipelines.config.run import RunConfig
from pipelines.config.setting import Folder, FreeText, check_settings
from pipelines.engine.archive import opened
from pipelines.engine.store import exists, read_json
from pipelines.errors import MissingInputError, PipelineError
from pipelines.play.actor_files import load_actor
from pipelines.play.environments import state_limits


@dataclass(frozen=True)
class VerifyConfig:
    """What `otr-verify` takes; None is the run's own."""

    run: FreeText
    certificate: FreeText | None
    tree: FreeText | None
    actor: FreeText | None
    results_dir: Folder
    debug: bool

    def __post_init__(self) -> None:
        check_settings(self)


def verify_run(config: VerifyConfig, run: RunConfig, folder: Path) -> str:
    """Check a run's certificate against its tree and its actor, and return what it proves, in words.

    Raises:
        MissingInputError: the run has no certificate; names the override that makes one.
        PipelineError: the certificate's domain is smaller than the environment's box of states.
        otr.OtrError: the certificate, the tree or the actor was tampered with; names the leaf.
    """
    path = Path(config.certificate or folder / "certify" / "certificate.json")
    if not exists(path):
        raise MissingInputError(
            f"{path} is not there: the run has no certificate\nAdd certify=true to the command that made the run; "
            "nothing is trained anew. A tree that was too large for one says so in certify/report.json."
        )
    with opened(folder, ["certify"]) as whole:
        certificate = otr.load_certificate(config.certificate or whole / "certify" / "certificate.json")
        tree = otr.load(config.tree or whole / "certify" / "tree")
    limits, domain = state_limits(run.env), certificate.domain
    if limits and not ((domain.low <= limits[0]).all() and (domain.high >= limits[1]).all()):
        raise PipelineError(
            f"{path} is of the box {_box(domain)}, which is smaller than the environment's, "
            f"{_box(otr.Domain(*limits))}: it was changed, or is of another environment"
        )
    if not isinstance(tree, otr.ObliqueTree):
        raise otr.CertificateError(f"{config.tree} holds a {type(tree).__name__}, certificates are of an ObliqueTree")
    network = load_actor(Path(config.actor or folder / certified_stage(run, folder)))
    bound = otr.verify(certificate, tree, network)
    whose = "the environment's box of states" if limits else "the box of the certificate"
    return (
        f"verified: {certificate.n_leaves:,} leaves, {certificate.n_regions:,} regions of the network; on {whose}, "
        f"{_box(domain)}, tree and network differ by at most {bound:.3g} at every real "
        "point (in rational arithmetic)"
    )


def certified_stage(run: RunConfig, folder: Path) -> str:
    """Return the stage of a run whose actor its certificate is of: polish after polish=true, else train or import."""
    report = read_json(folder / "certify" / "report.json")
    return "polish" if report.get("policy") == "polished" else run.method.actor_stage


def _box(domain: otr.Domain) -> str:
    """Return a box as people read it."""
    sides = zip(domain.low.tolist(), domain.high.tolist(), strict=True)
    return " x ".join(f"[{low:.4g}, {high:.4g}]" for low, high in sides)
