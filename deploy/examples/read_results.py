# %% Reads the result table of a sweep: pip install polars; python read_results.py study/results.parquet
import sys

import polars as pl

runs = pl.read_parquet(sys.argv[1] if len(sys.argv) > 1 else "study/results.parquet")
# Columns before the metrics identify a cell, including swept fields; scenario_hash also depends on the seed.
metrics = runs.columns[runs.columns.index("info_p1") : -1]
cell = [name for name in runs.columns if name not in [*metrics, "scenario_hash", "seed", "digest"]]
print(runs.select(*cell, "seed", "info_p1", "misdetection_pct"))

# %% Mean and standard error of every metric by cell. Undefined metrics (no events) are null and left out.
values = pl.col(metrics)
cells = runs.group_by(cell, maintain_order=True).agg(
    values.mean(), (values.std() / values.count().sqrt()).name.suffix("_se"), runs=pl.len()
)
print(cells.select(*cell, "runs", "info_p1", "info_p1_se"))

# %% All cells have the same seeds: a comparison run by run removes the variation between deployments.
policies = runs["policy"].unique(maintain_order=True).to_list()
rest = [name for name in cell if name != "policy"]
pairs = runs.pivot(on="policy", index=[*rest, "seed"], values="energy_per_device_tti")
for other in policies[1:]:
    difference = (pl.col(other) - pl.col(policies[0])).mean().alias(f"{other} - {policies[0]}")
    print(pairs.group_by(rest, maintain_order=True).agg(difference))
