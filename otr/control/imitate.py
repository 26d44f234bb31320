"""A tree that imitates a policy, in one call: DAgger in an environment, with the learners of `otr-run`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import fields
from functools import partial
from numbers import Integral
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from otr import control
from otr.control.dagger.loop import DaggerProgress, DaggerResult, Play, TreeFit, run_dagger
from otr.control.rollout import Rollout, rollout
from otr.control.search.polish import PolishReport
from otr.control.search.polish import polish as search_numbers
from otr.control.settings import (
    AugTreeSettings,
    CartSettings,
    CriticPolishSettings,
    DaggerSettings,
    ExpertsSettings,
    FitSettings,
    ModelTreeSettings,
    NdpsSettings,
    StudentSettings,
)
from otr.core.arrays import FloatArray, IntArray
from otr.core.mapping import map_network
from otr.core.pattern_tree import PatternTree
from otr.core.smooth_network import Oracle
from otr.core.tree import ObliqueTree
from otr.extras import naming_the_extra
from otr.importers.critics import Critics
from otr.setting import check_settings

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
    depth: int | Sequence[int] = 3,
    *,
    n_rounds: int = 20,
    n_episodes: int = 10,
    n_choice_episodes: int = 50,
    max_steps: int | None = None,
    polish: bool | Critics | Mapping[str, Any] = False,
    seed: int = 0,
    progress: bool = True,
    **options: Any,
) -> ObliqueTree:
    """Return a tree that imitates a policy, the best of DAgger's rounds on episodes of its own (Ross et al. 2011).

    It is for policies that no tree equals, and for shorter trees than a network's. What the policy and the tree return
    on the episodes that choose is printed; `evaluate` plays others.

    Args:
        policy: as `read_policy` returns it; without a head, its largest output is the label, or all are clipped.
        env: the id of a registered environment, a function that makes one, or an environment; as `rollout` takes it.
        method: "augtree" (tests on the state and the policy's hidden units), "viper" (CART), "lm_viper" (CART with
            affine leaves), "ndps" (oblique tests, affine leaves), "distilled_otr" (a small network, mapped), or
            "experts" (linear ones, of which one acts; for continuous actions).
        depth: tests on a path; hidden neurons of "distilled_otr", at most 16 in all; the number of "experts".
        n_rounds: in which the newest tree plays, and the next one is fitted.
        n_episodes, max_steps: of a round, and of an episode, as `rollout` takes it.
        n_choice_episodes: on which the last two candidates are compared.
        polish: whether direct search then improves the tree's numbers on the return, or arguments of `otr.polish`. Of
            continuous actions also the policy's critics (`read_critics`), by which the soft actor-critic improves them
            in 100,000 steps, or these as "critics" with settings of `CriticPolishSettings` or `otr.polish`.
        seed: of episodes and fits.
        progress: whether lines on stderr say how far it is.
        options: of the method's fit, such as `min_samples_leaf`; see `otr.control.settings`.

    Raises:
        ValueError: there is no such method, or critics are another policy's; or as `rollout`.
        TypeError: the fit has no such option, or the policy's head does not suit the method or critics.
        MissingExtraError: gymnasium, scikit-learn or torch is not installed.

    Examples:
        >>> policy = otr.ReluNetwork([[[0, 0, -1, -1], [0, 0, 1, 1]]], [[0, 0]], head=otr.Argmax())
        >>> tree = otr.imitate(policy, "CartPole-v1", "viper", depth=1, n_rounds=1, n_episodes=2, n_choice_episodes=2)
        >>> tree.depth
        1
    """
    if method not in METHODS:
        raise ValueError(f"method={method!r}, expected one of {', '.join(METHODS)}")
    settings = METHODS[method](**options)
    policy, feature_names = _fitted(policy, env)

    def play(playing: Any, seeds: Sequence[int], keep_states: bool) -> Rollout:
        return rollout(env, playing, seeds=seeds, max_steps=max_steps)

    shown = _Shown(progress)
    improve = _improvement(polish, policy, env, play, max_steps, seed, shown)
    with TemporaryDirectory(prefix="otr-") as place:
        result = run_dagger(
            policy,
            tree_fit(settings, depth, policy, Path(place)),
            play,
            partial(_seeds, seed),
            DaggerSettings(n_rounds, n_episodes, n_episodes, n_choice_episodes),
            np.random.SeedSequence(seed, spawn_key=(len(_EPISODES),)),
            Path(place),
            on_round=shown.round,
        )
    shown.say(f"{method} of depth {depth}, {_summary(result)}")
    found = result.tree
    tree = map_network(improve(found.network)) if isinstance(found, PatternTree) else improve(found)
    return tree.replace(feature_names=feature_names) if feature_names else tree


def _summary(result: DaggerResult) -> str:
    chosen = result.iterates[result.round]
    return (
        f"{chosen.n_leaves:,} leaves: return {chosen.selection_mean:.1f} over {chosen.n_selection_episodes} episodes, "
        f"the policy's {result.oracle_mean:.1f}"
    )


def _fitted(policy: Oracle, env: Any) -> tuple[Oracle, list[str]]:
    """Return a policy with a head that answers with an environment's actions, and names of the features, if any."""
    from otr.control.environments import playable
    from otr.control.spaces import keyed_names, with_answers

    make, makes_several = playable(env)
    one = make()
    fitted, names = with_answers(policy, one), keyed_names(one)
    if makes_several:
        one.close()
    return fitted, names


def _seeds(seed: int, name: str, index: int, n: int) -> list[int]:
    generator = np.random.default_rng([seed, _EPISODES.index(name), index])
    return [int(each) for each in generator.integers(*_SEEDS, n)]


def _improvement(
    polish: bool | Critics | Mapping[str, Any],
    policy: Oracle,
    env: Any,
    play: Play,
    max_steps: int | None,
    seed: int,
    shown: _Shown,
) -> Callable[[Any], Any]:
    """Return the function that improves the numbers of a tree or network on the return."""
    given = {"critics": polish} if isinstance(polish, Critics) else polish
    options: dict[str, Any] = dict(given) if isinstance(given, Mapping) else {}
    critics = options.pop("critics", None)

    def returns(policies: Sequence[Any], seeds: IntArray) -> FloatArray:
        return np.stack(
            [play(each.predict, row.tolist(), False).returns for each, row in zip(policies, seeds, strict=True)]
        )

    def searched(found: Any) -> Any:
        states = play(found.predict, _seeds(seed, "selection", 2**20, 10), True).states
        return search_numbers(found, returns, states=states, seed=seed, report=shown.polish, **options)

    if critics is None:
        return searched if polish else lambda found: found

    from otr.control.critic_polish.learner import polish_by_critics  # these import torch
    from otr.control.critic_polish.policy_actor import check_critics
    from otr.control.environments import GymnasiumVectorEnv, limited, playable

    check_critics(critics, policy)
    names = {field.name for field in fields(CriticPolishSettings)} & options.keys()
    settings = CriticPolishSettings(**{name: options.pop(name) for name in names})
    check_settings(settings)

    def learnt(found: Any) -> Any:
        make, makes_several = playable(env)
        envs = GymnasiumVectorEnv(limited(make, max_steps))
        seeds = _seeds(seed, "selection", 2**20 + 1, 3)
        with closing(envs) if makes_several else nullcontext():
            return polish_by_critics(
                found, returns, envs, critics, policy, seeds=seeds, settings=settings, seed=seed,
                learns_first=not makes_several, report=shown.polish, say=shown.say, **options
            )  # fmt: skip

    return learnt


class _Shown:
    """Prints how far imitation and polish are, every few seconds at most, and what comes out."""

    def __init__(self, progress: bool) -> None:
        self._progress, self._printed_at, self._n_candidates = progress, time.monotonic(), 0

    def say(self, text: str) -> None:
        if self._progress:
            print(f"imitate: {text}", file=sys.stderr, flush=True)

    def round(self, done: DaggerProgress) -> None:
        so_far = f"{done.n_leaves:,} leaves, return {done.return_mean:.1f}"
        self._say_seldom(f"round {done.round} of {done.n_rounds}, {so_far}")

    def polish(self, done: PolishReport) -> None:
        (_, before), (step, now) = done.candidates[0], done.candidates[-1]
        is_end, self._n_candidates = len(done.candidates) == self._n_candidates, len(done.candidates)
        if done.confirmation is not None:
            before, after = done.confirmation
            self.say(f"polished, return {after:.1f}, before {before:.1f}: {'kept' if done.kept else 'not kept'}")
        elif is_end:
            self.say(f"not polished: no candidate returns more than {before:.1f}")
        else:
            self._say_seldom(f"polish, {step:,} of {done.n_iterations:,}: return {now:.1f}, before {before:.1f}")

    def _say_seldom(self, text: str) -> None:
        if time.monotonic() - self._printed_at > _EVERY_S:
            self._printed_at = time.monotonic()
            self.say(text)


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
    widths = tuple(depth) if isinstance(depth, Sequence) else (depth,)
    least = 0 if kind is StudentSettings else 1
    if not all(isinstance(width, Integral) and width >= least for width in widths):
        raise ValueError(f"depth={depth}, expected a whole number from {least} on")
    if len(widths) != 1 and kind is not StudentSettings:
        raise ValueError(f"depth={depth}, expected a number; several widths are for method='distilled_otr'")

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
