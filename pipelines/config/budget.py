"""How much a run spends: a file of conf/budget."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class BudgetConfig:
    """How much is spent. The rest is the same for all tasks.

    Attributes:
        steps: environment steps per task.
        on_policy_steps: the same for soft trees and augmented random search, whose steps are cheaper and teach less.
        on_policy_interval_steps: between their evaluations. Training goes on with new episodes after each, in several
            environments at once, so there have to be enough steps for whole episodes.
        pid: what is spent on PID policies in place of the above: steps, eval_interval_steps, n_selection_episodes and
            n_evaluation_episodes.
    """

    name: str
    steps: dict[str, int]
    eval_interval_steps: int
    n_selection_episodes: int
    n_prune_episodes: int
    n_evaluation_episodes: int
    max_learning_starts: int
    n_rounds: int = 50
    n_round_episodes: int = 25
    n_choice_episodes: int = 100
    on_policy_steps: dict[str, int] = field(default_factory=dict)
    on_policy_interval_steps: int = 25_000
    pid: dict[str, int] = field(default_factory=dict)
