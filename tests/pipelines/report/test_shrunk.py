"""The table of shrinking: what a polished policy is compared with, read again from its runs."""

import statistics

from pipelines.engine.store import read_csv, read_json
from pipelines.report.shrunk import shrunk_table
from tests.committed import RESULTS


def test_a_line_has_the_means_of_its_runs_and_of_those_they_are_compared_with():
    runs = RESULTS / "runs/halfcheetah"
    summaries = [read_json(runs / f"distilled_otr/depth-32/standard-shrink/seed-{s}/summary.json") for s in (3, 4, 5)]
    nothing = [read_json(runs / f"otr/depth-32/standard-fleet/seed-{s}/summary.json")["return_mean"] for s in range(3)]
    kinds = [[each["policies"][form]["return_mean"] for each in summaries] for form in ("oracle", "pruned_tree")]
    kinds += [[each["polish"]["return_mean"] for each in summaries], nothing]
    oracle = sum(
        float(row["seconds"])
        for s in (3, 4, 5)
        for row in read_csv(runs / f"otr/depth-256-256/standard-fleet/seed-{s}/train/progress.csv")
    )
    after = sum(each["seconds"]["imitate"] + each["polish"]["cpu_seconds"] for each in summaries)
    expected = [
        "HalfCheetah, OTR (32)", "3",
        *(f"{statistics.mean(each):,.0f} ± {statistics.stdev(each):,.0f}" for each in kinds),
        "10,307.9", f"{statistics.mean(each['total_steps'] for each in summaries) / 1e6:.2f}M",
        f"{oracle / 180:.0f} + {after / 180:.0f}",
    ]  # fmt: skip
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in shrunk_table(RESULTS).splitlines()]
    assert expected in lines
    (ndps,) = (line for line in lines if line[0] == "HalfCheetah, NDPS (6)")
    assert ndps[5] == "-"
    linear = [read_json(RESULTS / f"runs/ant/linear/depth-0/standard-fleet/seed-{s}/summary.json") for s in range(3)]
    returns = [each["return_mean"] for each in linear]
    (line,) = (line for line in lines if line[0] == "Ant, linear (0)")
    assert line[5:7] == [f"{statistics.mean(returns):,.0f} ± {statistics.stdev(returns):,.0f}", "-"]
    assert not any("nan" in cell for line in lines for cell in line)


def test_where_sac_was_not_run_from_nothing_is_by_search():
    place = RESULTS / "runs/walker2d/otr/depth-6/standard-ars"
    searched = [read_json(place / f"seed-{seed}/summary.json")["return_mean"] for seed in range(5, 10)]
    (line,) = (line for line in shrunk_table(RESULTS).splitlines() if line.startswith("| Walker2d, OTR (6)"))
    assert line.split("|")[6].strip() == f"{statistics.mean(searched):,.0f} ± {statistics.stdev(searched):,.0f}"
