"""Plans as they are printed: in whole columns, or below each job in a terminal that has too few."""

from pipelines.engine.wrapping import UNLIMITED
from pipelines.runs.plan import plan_lines

ROWS = [
    ("job", "plan", "time"),
    ("runs/hopper/viper/depth-6/standard-fleet/seed-0~57268ca6", "run, train oracle hopper/otr/depth-64", "19 min"),
    ("runs/hopper/viper/depth-6/standard-fleet/seed-0~bebc6aa2", "skip", ""),
]


def test_rows_stay_apart_where_nothing_limits_them():
    lines = plan_lines(ROWS, UNLIMITED).split("\n")
    assert [line.split()[0] for line in lines] == [folder for folder, _, _ in ROWS]
    assert lines[0].index("plan") == lines[1].index("run, train") == lines[2].index("skip")
    assert lines[1].endswith("run, train oracle hopper/otr/depth-64  19 min")


def test_what_is_planned_stands_below_a_job_in_a_narrow_terminal():
    assert plan_lines(ROWS, 60) == (f"{ROWS[1][0]}\n    {ROWS[1][1]}, 19 min\n{ROWS[2][0]}\n    skip")
