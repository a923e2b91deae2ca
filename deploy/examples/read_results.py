# %% Reads the result table of a sweep: pip install polars; python read_results.py study/results.parquet
import sys

import polars as pl
import polars.selectors as cs

runs = pl.read_parquet(sys.argv[1] if len(sys.argv) > 1 else "study/results.parquet")
print(runs.select("policy", "n", "seed", "info_per_event", "misdetection_pct"))

# %% Mean and standard error of every metric by cell. Undefined metrics (no events) are null and left out.
metrics = cs.float() - cs.contains(".")
cells = runs.group_by("policy", "n", maintain_order=True).agg(
    metrics.mean(), (metrics.std() / metrics.count().sqrt()).name.suffix("_se"), runs=pl.len()
)
print(cells.select("policy", "n", "runs", "info_per_event", "info_per_event_se"))

# %% All cells have the same seeds: compare policies run by run, which takes the deployments' spread out.
pair = runs.pivot(on="policy", index=["n", "seed"], values="energy_per_device_tti")
print(pair.group_by("n", maintain_order=True).agg((pl.col("random") - pl.col("knn")).mean().alias("random - knn")))
