"""Runs and sweeps of the policies of the program."""

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
    """The names of the policies that decide by themselves."""
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
    """A run in memory, as ``reveille run`` makes it.

    :param scenario: a preset or a scenario file.
    :param policy: one of :func:`policies`; the scenario's, where it is not said.
    :param actions: whether to tell how an environment does the same: ``actions``, (T, N) int8, an action for each of
        its steps, and ``stages``, (T,) int8, the stage of each. ``stepped`` is what the environment comes to with them.
        Its digest is that of the run if the policy sends δ as bits (``age-index``, ``q-learning``, ``dt``); the others
        send duty cycles, and then the digests differ, as more is sent, while events and energy are the same.
    :returns: ``digest``, 64 hexadecimal digits; ``metrics`` by name; ``policy_facts``; ``ttis_done``; ``complete``.
    :raises ValueError: the scenario is refused; it says which field, and what is allowed.
    """
    changes = overrides(
        set, devices=devices, ttis=ttis, battery_knowledge=battery_knowledge, policy=policy, seed=seed
    )
    return dict((_native.watched if actions else _native.run)(scenario, changes))


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
    """Runs a grid of policies, sizes and other fields, and gives its table: one row for each run, with all metrics.

    Needs PyArrow; ``.to_pandas()`` and ``polars.from_arrow`` go on from there. Ctrl-C stops it.

    :param grid: further fields by their paths, each with the values to take in turn.
    :param set: fields that are the same in all runs.
    :param seeds: runs in each cell, with the seeds ``first_seed`` and following.
    :param folder: where to keep the runs. A sweep that was stopped goes on there, and a table that is there is not
        made again. A temporary folder, where it is not said.
    :param threads: threads; as many as there are CPUs, where it is not said.
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
