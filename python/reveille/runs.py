"""Runs and sweeps of the built-in policies."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import _native
from .scenario import Setting, overrides, toml

if TYPE_CHECKING:
    import pyarrow


def policies() -> list[str]:
    """Returns the names of the built-in policies."""
    return list(_native.policies())


def run(
    scenario: str = "paper",
    *,
    policy: str | None = None,
    devices: int | None = None,
    ttis: int | None = None,
    battery_knowledge: str | None = None,
    seed: int | None = None,
    set: Mapping[str, Setting] | None = None,  # noqa: A002
    actions: bool = False,
) -> dict[str, Any]:
    """Makes a run in memory, as ``reveille run`` does.

    :param scenario: a preset or a scenario file.
    :param policy: one of :func:`policies`; by default the scenario's policy.
    :param actions: whether to return the equivalent environment actions: ``actions``, (T, N) int8, the action of each
        step, and ``stages``, (T,) int8, its stage. ``stepped`` is the result of an environment with these actions. Its
        digest equals the run's digest if the policy sends δ as bits (``age-index``, ``q-learning``, ``dt``). Other
        policies send duty cycles and so larger messages; the digests then differ, but events and energy are the same.
    :returns: ``digest``, 64 hexadecimal digits; ``metrics`` by name; ``policy_facts``; ``ttis_done``; ``complete``.
    :raises ValueError: the scenario is refused; the message names the field and the allowed values.
    """
    changes = overrides(
        set, devices=devices, ttis=ttis, battery_knowledge=battery_knowledge, policy=policy, seed=seed
    )
    return dict((_native.run_with_actions if actions else _native.run)(scenario, changes))


def sweep(
    scenario: str = "paper",
    *,
    policies: Sequence[str] | None = None,
    devices: Sequence[int] | None = None,
    ttis: Sequence[int] | None = None,
    grid: Mapping[str, Sequence[Setting]] | None = None,
    set: Mapping[str, Setting] | None = None,  # noqa: A002
    seeds: int = 1,
    first_seed: int = 1,
    folder: str | os.PathLike[str] | None = None,
    threads: int | None = None,
) -> pyarrow.Table:
    """Runs a grid of policies, sizes and other fields. Returns a table with one row for each run, with all metrics.

    Needs PyArrow; ``.to_pandas()`` and ``polars.from_arrow`` convert the table. Ctrl-C stops the sweep.

    :param grid: further fields by their paths, each with its list of values.
    :param set: fields that are the same in all runs.
    :param seeds: runs in each cell, with the seeds ``first_seed`` and following.
    :param folder: folder of the runs, temporary by default. A stopped sweep resumes there, and a finished table is not
        recomputed.
    :param threads: number of threads; by default the number of CPUs.
    :raises ValueError: the experiment is refused.
    """
    from pyarrow import parquet

    lists = {"policies": policies, "devices": devices, "ttis": ttis}
    lines = [f"scenario = {toml(scenario)}"]
    lines += [f"{name} = {toml(list(values))}" for name, values in lists.items() if values is not None]
    lines.append(f"seeds = {{ first = {first_seed}, count = {seeds} }}")
    for section, fields in (("set", set), ("grid", {path: list(values) for path, values in (grid or {}).items()})):
        lines.append(f"[{section}]")
        lines += [f"{path} = {toml(value)}" for path, value in (fields or {}).items()]
    text = "\n".join(lines) + "\n"
    threads = threads or os.cpu_count() or 1
    if folder is not None:
        return parquet.read_table(_native.sweep(text, Path(folder), threads))
    with tempfile.TemporaryDirectory() as made:
        return parquet.read_table(_native.sweep(text, Path(made) / "sweep", threads))
