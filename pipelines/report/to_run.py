"""The runs that Table 4.1's page is still to have: how many there are, and the command that makes the others."""

from collections import Counter
from typing import NamedTuple

import pandas as pd

from pipelines.report.cells import SHRUNK, TASK_NAMES
from pipelines.report.statistics import MIN_RUNS_FOR_INTERVAL as N_RUNS

EIGHT = tuple(TASK_NAMES)[:8]
RIVALS = ("viper", "lm-viper", "ndps", "pi-prl")
FIVE = 'depth=6 "seed=range(0,5)"'


class Wanted(NamedTuple):
    """Policies of which there are to be five runs each; `changes` are those of `load_runs`."""

    what: str
    tasks: tuple[str, ...]
    methods: tuple[str, ...]  # as tables name them
    depths: tuple[str, ...]
    budget: str
    command: str
    changes: str = ""


def longer(task: str, steps: str) -> str:
    """Return the settings of a search whose noise and steps fall further, and that plays more selection episodes."""
    budget = f"budget.search.{task}"
    return (
        f"{budget}.steps={steps} {budget}.eval_interval_steps=500_000 {budget}.n_selection_episodes=50 "
        "algo.noise_end=0.1 algo.step_size_end=0.05"
    )


CHANGED_BY_LONGER = (
    "algo.noise_end=0.1, algo.step_size_end=0.05, train.eval_interval_steps=500000, train.n_selection_episodes=50, "
    "train.steps="
)

# Of searches on fresh seeds, where settings were chosen on the others.
WANTED = (
    Wanted("experts", EIGHT, ("distilled-experts-polished",), ("4", "8", "16"), "standard-shrink",
           'otr-run -m env={tasks} method=distilled_experts depth=4,8,16 "seed=range(3,8)" trainer=shrink'),
    Wanted("shrunk networks", EIGHT, (SHRUNK,), ("0", "6", "32"), "standard-shrink",
           'otr-run -m env={tasks} method=distilled_otr depth=0,6,32 "seed=range(3,8)" trainer=shrink'),
    Wanted("imitators polished by critics", ("reacher", "walker2d", "halfcheetah", "ant", "pendulum"),
           ("viper-critic-polished", "lm-viper-critic-polished", "ndps-critic-polished"), ("6",), "standard-fleet",
           'otr-run -m env={tasks} method=viper,lm_viper,ndps depth=6 "seed=range(3,8)" polish=true'),
    Wanted("π-PRL polished by its own critics", ("reacher", "walker2d", "hopper", "halfcheetah", "ant", "pendulum"),
           ("pi-prl-critic-polished",), ("6",), "standard-fleet",
           f"otr-run -m env={{tasks}} method=pi_prl {FIVE} polish=true polishing.by=critic", "polishing.by=critic"),
    Wanted("imitators of SAC's oracles", ("hopper", "swimmer"), RIVALS[:3], ("6",), "standard-fleet",
           f"otr-run -m env={{tasks}} method=viper,lm_viper,ndps {FIVE} algo=sac trainer=fleet"),
    Wanted("longer searches of the walker", ("walker2d",), ("otr",), ("6", "32"), "standard-ars",
           f'otr-run -m env={{tasks}} method=otr depth=6,32 "seed=range(8,13)" {longer("walker2d", "30_000_000")}',
           CHANGED_BY_LONGER + "30000000"),
    Wanted("longer searches of the hopper", ("hopper",), ("otr",), ("32",), "standard-ars",
           f'otr-run -m env={{tasks}} depth=32 "seed=range(6,11)" {longer("hopper", "20_000_000")}',
           CHANGED_BY_LONGER + "20000000"),
    Wanted("all methods beyond the table", ("mountaincar", "lunarlander"), (*RIVALS, "augtree"), ("6",), "quick",
           f"otr-run -m env={{tasks}} method=viper,lm_viper,augtree,ndps,pi_prl {FIVE} budget=quick"),
)  # fmt: skip


def to_run(runs: pd.DataFrame) -> list[list[str]]:
    """Return a head and a line for each kind of policy of which runs are missing.

    Args:
        runs: rows of `table_runs` and `variant_runs`, with `changes`.
    """
    lines = [["What", "Policies, and their runs", "Command"]]
    keys = ["task", "method", "depth", "budget", "changes"]
    by_recipe = (runs["method"] == "otr") & (runs["budget"] == "standard-shrink")  # shrunk, as the table's own OTR
    own = runs.assign(method=runs["method"].mask(by_recipe, SHRUNK)).fillna({"changes": ""})
    n_runs = own.groupby(keys)["seed"].nunique().to_dict()
    for wanted in WANTED:
        cells = [(task, method, depth) for task in wanted.tasks for method in wanted.methods for depth in wanted.depths]
        counts = {cell: n_runs.get((*cell, wanted.budget, wanted.changes), 0) for cell in cells}
        counts = {cell: n for cell, n in counts.items() if n < N_RUNS}
        if counts:
            policies = Counter(counts.values())
            have = [f"{policies[n]} with {f'{n} of {N_RUNS}' if n else 'none'}" for n in sorted(policies, reverse=True)]
            tasks = ",".join(dict.fromkeys(task for task, *_ in counts))
            lines.append([wanted.what, ", ".join(have), f"`{wanted.command.format(tasks=tasks)}`"])
    return lines
