"""How much a run spends: a file of conf/budget."""

from dataclasses import dataclass, field

from otr.control.settings import CriticPolishSettings, DaggerSettings
from otr.setting import CountOrZero
from pipelines.config.setting import Count, FreeText


@dataclass(frozen=True)
class BudgetConfig:
    """How much is spent. Tables are by task, with `others` for those that they do not name; the rest is for all."""

    name: FreeText
    steps: dict[str, Count]  # environment steps per task
    eval_interval_steps: Count
    n_selection_episodes: Count
    n_prune_episodes: Count
    n_evaluation_episodes: Count
    max_learning_starts: CountOrZero
    # In place of n_evaluation_episodes for the evaluation itself, for tasks where more of them are cheap
    evaluation_episodes: dict[str, Count] = field(default_factory=dict)
    n_rounds: CountOrZero = DaggerSettings.n_rounds
    n_round_episodes: Count = DaggerSettings.n_episodes
    n_choice_episodes: CountOrZero = DaggerSettings.n_choice_episodes
    # The same for soft trees, whose steps are cheaper and teach less
    on_policy_steps: dict[str, Count] = field(default_factory=dict)
    # Steps between their evaluations. Training goes on with new episodes after each, in several environments at
    # once, so a segment needs enough steps for whole episodes.
    on_policy_interval_steps: Count = 25_000
    # Environment steps of polishing per task, about
    polish_steps: dict[str, Count] = field(default_factory=dict)
    # Environment steps of polishing by critics, and of the play before it
    critic_steps: Count = CriticPolishSettings.steps
    refill_steps: Count = CriticPolishSettings.refill_steps
    # What is spent on PID policies in place of the above: steps, eval_interval_steps, n_selection_episodes,
    # n_evaluation_episodes and polish_steps
    pid: dict[str, Count] = field(default_factory=dict)
    # What trainer=shrink spends where a task needs another: steps of the oracle, n_rounds of imitation
    shrink: dict[str, dict[str, Count]] = field(default_factory=dict)
    # What is spent on direct search in place of the above, per task: steps, eval_interval_steps, n_selection_episodes
    search: dict[str, dict[str, Count]] = field(default_factory=dict)
