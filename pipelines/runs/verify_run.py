"""What is proved of a policy: a run's certificate, checked again without a solver, and a program compared."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import otr
from pipelines.config.env import EnvConfig
from pipelines.config.run import RunConfig
from pipelines.config.setting import Folder, FreeText, NotNegative, check_settings, results_folder
from pipelines.config.stages import Side
from pipelines.engine.archive import opened
from pipelines.engine.store import exists, read_json
from pipelines.errors import ConfigError, MissingInputError, PipelineError
from pipelines.play.actor_files import load_actor
from pipelines.play.boxes import box_around, box_in_words, given_box
from pipelines.play.spaces import action_names, feature_names, state_limits
from pipelines.runs.finished_run import command_of, tree_of, visited_states
from pipelines.runs.questions import Answer, answer_in_words, bound_text, in_words, labels_but, number_of
from pipelines.stages.certify import GIVEN, MARGIN

MAX_DIFFERENCE = 1e-6


@dataclass(frozen=True)
class VerifyConfig:
    """What `otr-verify` takes; None is the run's own."""

    run: FreeText = ""
    program: FreeText | None = None  # compared with the run's network or with `tree`, or asked about
    env: FreeText | None = None  # the program's, where no run is named
    always: FreeText | None = None
    range: bool = False
    box: list[Side] | None = None
    max_difference: NotNegative | None = None
    max_seconds: NotNegative | None = None
    certificate: FreeText | None = None
    tree: FreeText | None = None
    actor: FreeText | None = None
    results_dir: Folder = field(default_factory=results_folder)
    debug: bool = False

    def __post_init__(self) -> None:
        check_settings(self)


def verify_run(config: VerifyConfig, run: RunConfig, folder: Path) -> str:
    """Check a run's certificate against its tree and its actor, and return what it proves, as text.

    Raises:
        MissingInputError: the run has no certificate; names the override that makes one.
        PipelineError: the certificate's domain is smaller than the environment's box of states.
        otr.OtrError: the certificate, the tree or the actor was tampered with; names the leaf.
    """
    path = Path(config.certificate or folder / "certify" / "certificate.json")
    if not exists(path):
        report = folder / "certify" / "report.json"
        reason = read_json(report).get("reason") if exists(report) and not config.certificate else None
        command = command_of(folder, run.method.actor_stage)
        command += "" if "certify=true" in command.split() else " certify=true"
        raise MissingInputError(
            f"{path} is not there: the run has no certificate"
            + (f", as stage certify gave up: {reason}" if reason else f"\nRun: {command}\nNothing is trained again.")
        )
    with opened(folder, ["certify"]) as whole:
        certificate = otr.load_certificate(config.certificate or whole / "certify" / "certificate.json")
        if isinstance(certificate, otr.FixedPointCertificate):
            return _verify_fixed_point(config, run, folder, certificate)
        tree = otr.load(config.tree or whole / "certify" / "tree")
    limits, domain = wanted_box(run), certificate.domain
    if limits and not ((domain.low <= limits[0].low).all() and (domain.high >= limits[0].high).all()):
        raise PipelineError(
            f"{path} is of the box {_named(domain, run.env)}, which is smaller than {limits[1]}, "
            f"{_named(limits[0], run.env)}: it was changed, or is of another environment"
        )
    if not isinstance(tree, otr.ObliqueTree):
        raise otr.CertificateError(f"{config.tree} holds a {type(tree).__name__}, certificates are of an ObliqueTree")
    network = load_actor(Path(config.actor or folder / certified_stage(run, folder)))
    bound = otr.verify(certificate, tree, network)
    whose = limits[1] if limits else "the box of the certificate"
    leaves, regions = number_of(certificate.n_leaves, "leaf"), number_of(certificate.n_regions, "region")
    return (
        f"verified: {leaves}, {regions} of the network; on {whose}, {_named(domain, run.env)}, at every real point (in "
        f"rational arithmetic), tree and network {_alike(bound, tree)}"
    )


def _verify_fixed_point(
    config: VerifyConfig, run: RunConfig, folder: Path, certificate: otr.FixedPointCertificate
) -> str:
    """Check a certificate of a tree in fixed point and a run's network or pruned tree, and return what it proves."""
    fixed = otr.load(config.tree) if config.tree else None
    if not isinstance(fixed, otr.FixedPointTree):
        raise ConfigError(
            f"tree={config.tree}: {config.certificate} is of a FixedPointTree; add tree=FILE, written by otr.save"
        )
    is_of_network = certificate.margins is None
    actor = Path(config.actor or folder / certified_stage(run, folder))
    bound = otr.verify(certificate, fixed, load_actor(actor) if is_of_network else tree_of("pruned", run, folder))
    where = f"on the box {_named(certificate.box, run.env)}, at every real point (in rational arithmetic)"
    whose = "the network" if is_of_network else "the pruned tree, but nearer to its tests than their margins,"
    if fixed.head.gives_labels:
        return (
            f"verified: {where}, the integers' label is that of {whose} where its lead is above {bound_text(bound, 3)}"
        )
    return f"verified: {where}, what the integers answer and {whose} differ by at most {bound_text(bound, 3)}"


def certified_stage(run: RunConfig, folder: Path) -> str:
    """Return the stage whose actor is a run's network: polish after polish=true, else train or import.

    A certificate names its policy; without one the polished actor counts, where there is one.
    """
    report = folder / "certify" / "report.json"
    if exists(report):
        is_polished = read_json(report).get("policy") == "polished"
    else:
        is_polished = exists(folder / "polish" / "actor.json")
    return "polish" if is_polished else run.method.actor_stage


def _alike(bound: float, tree: otr.ObliqueTree) -> str:
    """Return by how much a tree and a network may differ, as text."""
    if tree.labels is None or not bound:
        return f"differ by at most {bound_text(bound, 3)}" if bound else "are equal"
    return f"have the same label, but perhaps {labels_but(bound)}"


def _named(domain: otr.Domain, env: EnvConfig) -> str:
    """Return a box as text, with the names of the environment's states."""
    return box_in_words(domain, feature_names(env, domain.n_inputs))


def wanted_box(run: RunConfig) -> tuple[otr.Domain, str] | None:
    """Return the box that the user gave the run or that the environment declares, and which; None without either."""
    if run.certification.box is not None:
        return given_box(run.env, run.certification.box), GIVEN
    limits = state_limits(run.env)
    return None if limits is None else (otr.Domain(*limits), "the environment's box of states")


def question_domain(
    sides: Sequence[str] | None, run: RunConfig, folder: Path | None, policy: otr.ObliqueTree | None
) -> tuple[otr.Domain, str]:
    """Return the box of states that is asked about, and what it is.

    It is that of `sides`, else the run's own or the environment's, else that of the run's certificate, else the box
    around the states that the policy visits in a few episodes.

    Raises:
        ConfigError: a side is of no state, or there is no box and no policy that could play.
    """
    wanted = (given_box(run.env, sides), GIVEN) if sides is not None else wanted_box(run)
    if wanted is not None:
        domain, what = wanted
    elif folder is not None and exists(folder / "certify" / "report.json"):
        report = read_json(folder / "certify" / "report.json")
        domain, what = otr.Domain.from_dict(report), f"{report['domain']}, as the certificate is"
    else:
        assert policy is not None
        states = visited_states(run, policy)
        domain, what = (
            box_around(states, MARGIN),
            "the box around the states that it visits in a few episodes (box= asks of another)",
        )
    return domain, f"{what}, {_named(domain, run.env)}"


def compared(
    tree: otr.ObliqueTree,
    other: otr.ObliqueTree | otr.ReluNetwork,
    env: EnvConfig,
    domain: otr.Domain,
    bound: float | None,
    *,
    what: str,
) -> Answer:
    """Return whether a program's tree differs from `what`, a tree or network, by no more than a bound on a box.

    Without a bound it is `MAX_DIFFERENCE`; labels are equal or not.

    Raises:
        ConfigError: they cannot be compared.
    """
    if tree.labels is not None and bound is not None:
        raise ConfigError(f"max_difference={bound:g}: the answers are labels, which are equal or not; leave it out")
    bound = MAX_DIFFERENCE if bound is None else bound
    before = {otr.TanhBox: " before the tanh", otr.Exp: " before the exp"}.get(type(tree.head), "")
    try:
        if isinstance(other, otr.ReluNetwork):
            certificate = otr.certify(tree, other, domain, max_error=bound)
            otr.verify(certificate, tree, other)
            return Answer(True, f"proved: the program and {what} {_alike(certificate.max_error, tree)}{before}")
        allowed = bound if tree.labels is None else 0.0
        verdict = otr.find_difference(tree, other, domain, max_difference=allowed)
    except otr.CertificateError as error:
        if error.state is None:
            return Answer(None, f"undecided: {error}")
        state = np.array([float(value) for value in error.state])
    except ValueError as error:
        hint = ""
        if isinstance(other.head, otr.TanhBox) and not isinstance(tree.head, otr.TanhBox):
            low, high = other.head.limits(other.n_outputs)
            half = (high[0] - low[0]) / 2
            hint = f"\nThe answers of {what} are a tanh: write those of the program as return {half:g} tanh(...)"
        raise ConfigError(f"the program and {what} cannot be compared: {error}{hint}") from error
    else:
        if verdict.state is None:
            size = f"{_alike(verdict.value, tree)}{before}"
            return Answer(True, f"proved: the program and {what} {size if tree.labels is None else 'answer alike'}")
        state = verdict.state
    place = in_words(feature_names(env, len(state)), state)
    names = action_names(env, tree.n_answers)
    ours, theirs = (answer_in_words(each, state, names) for each in (tree, other))
    return Answer(False, f"differ: at {place}, the program answers {ours}, {what} {theirs}")
