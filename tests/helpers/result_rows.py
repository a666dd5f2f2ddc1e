"""A row of docs/results.md for tests of it: two seeds on two cores."""

from __future__ import annotations

from benchmarks.results.rows import Row, Section

CPU = Section(title="Two CPU cores", arguments="scale=smoke device=cpu", threads=2)
ROW = Row(
    name="reach",
    section=CPU,
    title="One fixed goal",
    model="TD-MPC2, MPPI",
    arguments="env=reach_fixed",
    seeds=(100, 101),
    wanted={"minutes": 1, "distance_cm": 1.5, "within_5cm": 90},
    readme=True,
)
