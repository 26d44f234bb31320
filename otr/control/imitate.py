"""A tree that imitates a policy, in one call: DAgger in an environment, with the learners of `otr-run`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from otr import control
from otr.control.dagger.loop import DaggerProgress, TreeFit, run_dagger
from otr.control.rollout import rollout
from otr.control.settings import (
    AugTreeSettings,
    CartSettings,
    DaggerSettings,
    ExpertsSettings,
    FitSettings,
    ModelTreeSettings,
    NdpsSettings,
    StudentSettings,
)
from otr.core.mapping import map_network
from otr.core.pattern_tree import PatternTree
from otr.core.smooth_network import Oracle
from otr.core.tree import ObliqueTree
from otr.extras import naming_the_extra

_SEEDS = (2**24, 2**31)  # of the episodes; those below are for reports and `rollout`
_EPISODES = ("oracle", "dagger", "selection")
_EVERY_S = 5.0
METHODS: dict[str, type[FitSettings]] = {
    "augtree": AugTreeSettings,
    "viper": CartSettings,
    "lm_viper": ModelTreeSettings,
    "ndps": NdpsSettings,
    "distilled_otr": StudentSettings,
    "experts": ExpertsSettings,
}


@naming_the_extra("otr.imitate")
def imitate(
    policy: Oracle,
    env: Any,
    method: str = "augtree",
    depth: int = 3,
    *,
    n_rounds: int = 20,
    n_episodes: int = 10,
    n_choice_episodes: int = 50,
    seed: int = 0,
    progress: bool = True,
    **options: Any,
) -> ObliqueTree:
    """Return a tree that imitates a policy, the best of DAgger's rounds on episodes of its own (Ross et al. 2011).

    It is for policies that no tree equals, such as those with tanh units, and for shorter trees than a network's. What
    the policy and the tree return on the episodes that choose is printed; `evaluate` plays others.

    Args:
        policy: a network, as `read_policy` returns it.
        env: the id of a registered environment, a function that makes one, or an environment; as `rollout` takes it.
        method: "augtree" (tests on the state and the policy's hidden units), "viper" (CART), "lm_viper" (CART with
            affine leaves), "ndps" (oblique tests, affine leaves), "distilled_otr" (a small network, mapped), or
            "experts" (linear ones, of which one acts; for continuous actions).
        depth: tests on a path; hidden neurons of "distilled_otr", at most 16; the number of "experts".
        n_rounds: in which the newest tree plays, and the next one is fitted.
        n_episodes: of a round.
        n_choice_episodes: on which the last two candidates are compared.
        seed: of episodes and fits.
        progress: whether lines on stderr say how far it is.
        options: of the method's fit, such as `min_samples_leaf`; see `otr.control.settings`.

    Raises:
        ValueError: there is no such method; or as `rollout`.
        TypeError: the fit has no such option, or the policy's head does not suit the method.
        MissingExtraError: gymnasium, scikit-learn or torch is not installed.

    Examples:
        >>> import otr
        >>> policy = otr.read_policy("policy.zip")  # doctest: +SKIP
        >>> tree = otr.imitate(policy, "CartPole-v1", method="augtree", depth=3)  # doctest: +SKIP
        >>> print(otr.to_text(tree))  # doctest: +SKIP
    """
    if method not in METHODS:
        raise ValueError(f"method={method!r}, expected one of {', '.join(METHODS)}")
    settings, printed_at = METHODS[method](**options), time.monotonic()

    def seeds(name: str, index: int, n: int) -> Sequence[int]:
        generator = np.random.default_rng([seed, _EPISODES.index(name), index])
        return [int(each) for each in generator.integers(*_SEEDS, n)]

    def show(done: DaggerProgress) -> None:
        nonlocal printed_at
        if progress and time.monotonic() - printed_at > _EVERY_S:
            printed_at = time.monotonic()
            so_far = f"{done.n_leaves:,} leaves, return {done.return_mean:.1f}"
            print(f"imitate: round {done.round} of {done.n_rounds}, {so_far}", file=sys.stderr, flush=True)

    with TemporaryDirectory(prefix="otr-") as place:
        result = run_dagger(
            policy,
            tree_fit(settings, depth, policy, Path(place)),
            lambda play, own, keep_states: rollout(env, play, seeds=own),
            seeds,
            DaggerSettings(n_rounds, n_episodes, n_episodes, n_choice_episodes),
            np.random.SeedSequence(seed, spawn_key=(len(_EPISODES),)),
            Path(place),
            on_round=show,
        )
    chosen = result.iterates[result.round]
    if progress:
        print(
            f"imitate: {method} of depth {depth}, {chosen.n_leaves:,} leaves: return {chosen.selection_mean:.1f} over "
            f"{chosen.n_selection_episodes} episodes, the policy's {result.oracle_mean:.1f} over {n_episodes}",
            file=sys.stderr, flush=True,
        )  # fmt: skip
    return map_network(result.tree.network) if isinstance(result.tree, PatternTree) else result.tree


def tree_fit(settings: FitSettings, depth: int | Sequence[int], oracle: Oracle, folder: Path) -> TreeFit:
    """Return the learner of a kind of settings, which may be of a subclass.

    Args:
        settings: one of `METHODS`.
        depth: tests on a path, experts, or the widths of a student's hidden layers.
        oracle: the network that is imitated.
        folder: for the learner's working files.

    Raises:
        TypeError: the oracle's head does not suit the learner.
        ValueError: a setting is out of its range.
    """
    kind = next(kind for kind in METHODS.values() if isinstance(settings, kind))
    options: dict[str, Any] = {field.name: getattr(settings, field.name) for field in fields(kind)}
    widths = (depth,) if isinstance(depth, int) else tuple(depth)

    def head() -> Any:
        return oracle.head if oracle.head.gives_labels else box()

    def box() -> Any:
        from otr.control.viper import box_of  # imports scikit-learn

        return box_of(oracle.head)

    fits: dict[type[FitSettings], Callable[[], TreeFit]] = {
        AugTreeSettings: lambda: control.AugTreeFit(oracle, *widths, **options),
        CartSettings: lambda: control.CartFit(*widths, **options),
        ModelTreeSettings: lambda: control.LinearModelTreeFit(oracle.head, *widths, **options),
        NdpsSettings: lambda: control.NdpsImitator(head(), *widths, folder, **options),
        StudentSettings: lambda: control.StudentFit(head(), tuple(each for each in widths if each), **options),
        ExpertsSettings: lambda: control.ExpertsFit(box(), *widths, **options),
    }
    return fits[kind]()
