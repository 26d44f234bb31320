"""The settings of imitation, of direct search and of polishing: each field's default and range, once.

The commands' configurations are subclasses (`pipelines/config`), which add no default. Nothing here loads a package.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from otr.setting import (
    AsBefore,
    BelowOne,
    Count,
    CountOrZero,
    Criterion,
    Hardness,
    LearningRate,
    Leaves,
    NotNegative,
    OneOf,
    Positive,
    Range,
    Share,
)


@dataclass(frozen=True)
class DaggerSettings:
    """How much is played: the oracle first, then the imitator, which is refitted after every round.

    Attributes:
        n_rounds: rounds in which a tree plays and the next one is fitted; n_rounds + 1 trees in all.
        n_episodes: episodes a tree plays in a round; they are its first selection episodes, too.
        n_initial_episodes: episodes of the oracle that the first tree is fitted to.
        n_choice_episodes: episodes on which the last two candidates are compared, those of the round counted; none of
            them is reported.
    """

    n_rounds: CountOrZero = 50
    n_episodes: Count = 25
    n_initial_episodes: Count = 25
    n_choice_episodes: CountOrZero = 100


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """The settings that the fits of all imitators share.

    Attributes:
        max_samples: rows drawn for a fit.
    """

    max_samples: Count = 25_000


@dataclass(frozen=True, kw_only=True)
class CartSettings(FitSettings):
    """Of `otr.control.CartFit`, VIPER.

    Attributes:
        min_samples_leaf: distinct rows in a leaf at least.
        criterion: of labels, "gini" or "entropy".
        weighted: draw the rows of labels by weight; else every row is as likely, which is DAgger with CART (Ross et
            al. 2011).
    """

    max_samples: Count = 100_000
    min_samples_leaf: Count = 1
    criterion: Annotated[Criterion, AsBefore("gini")] = "gini"
    weighted: Annotated[bool, AsBefore(True)] = True


@dataclass(frozen=True, kw_only=True)
class ModelTreeSettings(FitSettings):
    """Of `otr.control.LinearModelTreeFit`, LM-VIPER; the names are those of `LinearModelTreeRegressor`."""

    max_samples: Count = 100_000
    min_samples_leaf: Count = 10
    alpha: NotNegative = 0.1  # ridge


@dataclass(frozen=True, kw_only=True)
class AugTreeSettings(FitSettings):
    """Of `otr.control.AugTreeFit`.

    Attributes:
        features: "all" for [x, z_1], "z" for z_1, "deep" for [x, z_1, z_2, ...].
        leaves: "constant" or "linear".
        max_patterns: for "deep", activation patterns a layer.
        weighted: draw rows by weight, as VIPER does; else every row is as likely. A PPO oracle's weights are large
            where it is sure, far from the states that decide an episode.
        criterion: of constant leaves and labels: "entropy" or "gini". A tree with about as many leaves as there are
            labels has to give a rare one a leaf of its own, which Gini's gain rewards less.
        min_samples_leaf: drawn rows in a leaf at least.
    """

    features: Annotated[str, OneOf("all", "z", "deep")] = "all"
    leaves: Leaves = "constant"
    max_patterns: Count = 4
    weighted: bool = False
    criterion: Criterion = "entropy"
    max_samples: Count = 10_000
    min_samples_leaf: Count = 1


@dataclass(frozen=True, kw_only=True)
class StudentSettings(FitSettings):
    """Of `otr.control.StudentFit`, a small network.

    Attributes:
        dense: "input" for a linear map of the state next to the neurons, "none" for neurons alone.
        negative_slope: of the activation below zero.
        n_starts: networks that the fit begins with; the best of them goes on.
        n_updates: iterations of L-BFGS of the best start; each start has a quarter as many before.
        ridge: weight of the squares of all numbers.
    """

    dense: Annotated[str, OneOf("none", "input")] = "input"
    negative_slope: BelowOne = 0.0
    n_starts: Count = 3
    n_updates: Count = 200
    ridge: NotNegative = 1e-5


@dataclass(frozen=True, kw_only=True)
class NdpsSettings(FitSettings):
    """Of `otr.control.NdpsImitator` and, but for two, of `otr.control.fit_ndps`.

    Attributes:
        n_updates: Adam's updates; the time of a fit depends on them and not on the number of rows.
        n_updates_next: the imitator's, of a fit that goes on from the last round's tree.
        batch_size: rows an update.
        learning_rate: at first; it falls to zero along a cosine.
        beta_first, beta_last: how hard the tests are at first and in the end; beta grows geometrically.
        ridge: of the leaves' refit, towards the soft tree's leaves, in rows: 1 weighs as much as one row.
        leaves: "linear", a map of the state each, or "constant", an action or label each as in the thesis's Figure 4.5.
    """

    n_updates: Count = 2_000
    n_updates_next: Count = 200
    batch_size: Count = 512
    learning_rate: LearningRate = 0.02
    beta_first: Hardness = 1.0
    beta_last: Hardness = 50.0
    ridge: NotNegative = 1.0
    leaves: Annotated[Leaves, AsBefore("linear")] = "linear"

    @property
    def affine_leaves(self) -> bool:
        """Whether the leaves are maps of the state."""
        return self.leaves == "linear"


@dataclass(frozen=True, kw_only=True)
class ExpertsSettings(FitSettings):
    """Of `otr.control.ExpertsFit`.

    Attributes:
        n_updates: of Adam, whose learning rate falls linearly to zero.
        batch_size: rows an update.
        learning_rate: of the first update.
        balance: weight of how unevenly the experts are used.
    """

    n_updates: Count = 3_000
    batch_size: Count = 256
    learning_rate: LearningRate = 0.01
    balance: NotNegative = 0.01


@dataclass(frozen=True, kw_only=True)
class RelaxedProgramSettings:
    """Of `otr.control.RelaxedProgram`, pi-PRL.

    Attributes:
        structure_penalty: a hole's logit of `if` starts at minus this times the hole's level, so that a deeper program
            has to earn its depth.
    """

    structure_penalty: Annotated[float, Range(0, 100)] = 0.25


@dataclass(frozen=True)
class SearchSettings:
    """How a vector is searched; step and noise are in the units of its numbers.

    Attributes:
        n_directions: directions tried an iteration, each forth and back (N).
        n_top: the best of them, which make the step (b); fewer than all of them is the variant "-t" of the paper.
        step_size: length of a step along the estimated gradient, whose size is measured in standard deviations of the
            returns (alpha).
        noise: length of the directions, a standard deviation a number (nu).
        step_size_end, noise_end: the final values of the two, as shares; they fall linearly.
        momentum: weight of the former steps in a step; 0 is the paper's search.

    Examples:
        >>> settings = otr.SearchSettings(step_size=0.1, noise=0.1)
        >>> tree = otr.parse_program("x + 1", ["x"])
        >>> def returns(policies, seeds):
        ...     return [[-abs(p.predict([1.0])[0] - 3.0)] * seeds.shape[1] for p in policies]
        >>> better = otr.polish(tree, returns, states=[[0.0], [1.0]], n_iterations=30, settings=settings)
        >>> better.predict([1.0]).round(1)
        array([3.])
    """

    n_directions: Count = 8
    n_top: Count = 4
    step_size: Positive = 0.02
    noise: Positive = 0.025
    step_size_end: Share = 1.0
    noise_end: Share = 1.0
    momentum: BelowOne = 0.0

    def problem(self, prefix: str) -> str | None:
        """Return what is wrong between the settings, whose names begin with `prefix`; None where nothing is."""
        if self.n_top <= self.n_directions:
            return None
        return f"{prefix}n_top={self.n_top} is more than {prefix}n_directions={self.n_directions}"


@dataclass(frozen=True)
class PolishSettings(SearchSettings):
    """How `otr.polish` searches and chooses; step and noise are in units of a row of the policy.

    Attributes:
        scale: what step and noise of each number are multiplied by: 1 ("uniform"), or less where the actions react
            more to it ("sensitivity").
        n_episodes: of every vector tried.
        common_starts: who shares the starts of an iteration, the two policies of a direction ("pair") or "all".
        n_selection_episodes: of each candidate; as many more confirm the best.
        n_candidates: how many of the search's iterates are candidates, the last one among them.
        free: whether coefficients that are zero move, too.
    """

    n_directions: Count = 24
    n_top: Count = 12
    step_size: Positive = 0.03
    noise: Positive = 0.03
    step_size_end: Share = 0.05
    noise_end: Share = 0.2
    scale: Annotated[str, OneOf("uniform", "sensitivity"), AsBefore("uniform")] = "uniform"
    n_episodes: Count = 1
    common_starts: Annotated[str, OneOf("pair", "all")] = "pair"
    n_selection_episodes: Count = 100
    n_candidates: Count = 20
    free: bool = False


@dataclass(frozen=True)
class CriticPolishSettings:
    """Of a polish by critics: the soft actor-critic goes on with the finished policy in the actor's place.

    Attributes:
        steps: of the environment by the policy, an update each.
        refill_steps: that fill the replay buffer before, in which the oracle acts as it explored.
        student_share: of these, in which the policy itself acts: a weak policy needs data on its own mistakes.
        refill_noise: standard deviation of what is added to actions in [-1, 1] while the buffer is filled.
        noise: the same from then on.
        learning_rate: of Adam, for the policy and the critics.
        first_neurons: of a network of one hidden layer that has fewer, at first; the least useful go one by one, and
            learning rates fall. 0 for no more than it has.
        bounds_values: whether critics learn towards no more than the highest discounted sum of rewards that was played.
        batch_size: transitions an update.
    """

    steps: Count = 100_000
    refill_steps: Count = 50_000
    student_share: Share = 0.3
    refill_noise: NotNegative = 0.1
    noise: NotNegative = 0.1
    learning_rate: LearningRate = 1e-3
    first_neurons: Annotated[CountOrZero, AsBefore(0)] = 64
    bounds_values: Annotated[bool, AsBefore(False)] = True
    batch_size: Count = 100
