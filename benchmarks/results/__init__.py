"""Rows of docs/results.md: what is claimed, the runs that measure it, and the page made from what they wrote.

python -m benchmarks.results                               which rows are fresh, stale, missing
python -m benchmarks.results run reach-cpu                 every seed of a row, then its files in docs/results/
python -m benchmarks.results run reach-gpu lewm-gpu --missing --minutes 8 --jobs 3 --device cuda:0     of several rows
python -m benchmarks.results collect reach-cpu RUN RUN … --jobs 1     the same from runs that were started otherwise
python -m benchmarks.results confirm reach-cpu             that changed code does the same as the measured one
python -m benchmarks.results render                        docs/results.md and README's table from these files

rows.yaml declares the rows. A run's numbers, command, seed, commit, machine and date come from its own folder.
"""
