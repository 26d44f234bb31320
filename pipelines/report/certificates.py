"""The certificates of finished runs as one table: what is proved of which policy, where, and in what time."""

from pathlib import Path

import pandas as pd

from pipelines.report.cells import METHOD_NAMES, TASK_NAMES, in_order, method_name, reported
from pipelines.report.frames import load_runs
from pipelines.report.text import markdown_table, page, write_tables
from pipelines.runs.questions import bound_text

# The columns of the CSV file, and where `load_runs` has them.
COLUMNS = {
    "env": "env", "method": "method", "depth": "depth", "budget": "budget", "seed": "seed",
    "certified": "certify.certified", "domain": "certify.domain", "paths": "n_leaves", "leaves": "certify.n_leaves",
    "max_error": "certify.max_error", "linear_programs": "certify.n_linear_programs",
    "find_s": "certify.seconds.minimal_tree", "prove_s": "certify.seconds.certify", "check_s": "certify.seconds.verify",
    "reason": "certify.reason",
}  # fmt: skip
LINE = ["env", "method", "depth", "budget", "certified", "domain", "reason"]  # runs that share these share a line
HEAD = ["Task", "Method", "Depth", "Budget", "Runs", "Paths", "Leaves", "Proved on", "Error at most", "Seconds: find",
        "prove", "check"]  # fmt: skip


def write_certificates(results_dir: Path) -> list[Path]:
    """Write `certificates.md` and `certificates.csv` under `results_dir/tables` from the runs that have one.

    Smoke budgets and runs with other settings (`seed-<s>~<digest>`) are left out.
    """
    rows = _rows(load_runs(results_dir))
    table = markdown_table(_lines(rows), empty="No run under a budget's own settings has a certificate yet.")
    return write_tables(results_dir, "certificates", rows, page("certificates.md", table=table))


def certificate_lines(runs: pd.DataFrame) -> list[list[str]]:
    """Return a head and a line for the runs of `load_runs` that differ in their seed alone; nothing without any."""
    lines = _lines(_rows(runs))
    return lines if len(lines) > 1 else []


def _rows(runs: pd.DataFrame) -> pd.DataFrame:
    """Return what COLUMNS names of the runs that were certified, or tried, in the table's order."""
    runs = reported(runs)
    own = runs[(runs["form"] == "tree") & runs["certify.certified"].notna()]
    rows = pd.DataFrame({name: own.get(source) for name, source in COLUMNS.items()}, own.index)
    # A certificate after polish=true is of the polished network.
    of_polished = own["certify.policy"] == "polished" if "certify.policy" in own else pd.Series(False, own.index)
    rows = rows.assign(
        method=method_name(rows["method"]) + of_polished.map({True: "-polished"}).fillna(""),
        reason=rows["reason"].fillna(""),
    )
    return in_order(rows.sort_values([*LINE[3:], "seed"]), LINE[:3])


def _lines(rows: pd.DataFrame) -> list[list[str]]:
    """Return a head and a line for the runs that differ in their seed alone."""
    lines = [HEAD]
    for (env, method, depth, budget, certified, domain, reason), runs in rows.groupby(LINE, sort=False):
        names = [TASK_NAMES.get(env, env), METHOD_NAMES.get(method, method), depth, budget, str(len(runs))]
        paths = _range(runs["paths"])
        if not certified:
            lines.append([*names, paths, "", f"not proved: {reason}", "", "", "", ""])
            continue
        times = (f"{runs[f'{step}_s'].max():.2f}" for step in ("find", "prove", "check"))
        lines.append([*names, paths, _range(runs["leaves"]), domain, bound_text(runs["max_error"].max()), *times])
    return lines


def _range(values: pd.Series) -> str:
    least, greatest = values.min(), values.max()
    texts = [f"{n:,}" if n < 2**63 else f"2^{int(n).bit_length() - 1}" for n in (least, greatest)]
    return texts[0] if least == greatest else " to ".join(texts)
