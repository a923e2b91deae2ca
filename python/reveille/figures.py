"""Figures of a sweep's metric, a deployment or a timeline, drawn as by the command line."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from . import _native
from .scenario import Setting, overrides, toml

if TYPE_CHECKING:
    import pyarrow

#: A table of runs: the result of :func:`reveille.sweep`, or the path of a table or of a sweep's folder.
Table: TypeAlias = "pyarrow.Table | str | os.PathLike[str]"


class Figure:
    """A picture that a notebook displays directly."""

    __slots__ = ("_native",)

    def __init__(self, native: _native.Picture) -> None:
        self._native = native

    def __repr__(self) -> str:
        return f"<Figure {self.name}>"

    @property
    def name(self) -> str:
        """The file name, without its ending, that ``reveille figures`` would use."""
        return self._native.name

    @property
    def facet(self) -> dict[str, str]:
        """The fields that distinguish the picture from the other pictures of a sweep, with their values."""
        return dict(self._native.facet)

    @property
    def csv(self) -> str | None:
        """Data of a sweep chart, else None: line, x, metric, mean, half the width of its 95 % interval, runs."""
        return self._native.csv

    @property
    def undefined(self) -> tuple[str, ...]:
        """Lines that are not drawn because none of their runs has a value of the metric."""
        return tuple(self._native.undefined)

    @property
    def svg(self) -> str:
        """The picture as SVG."""
        return self._native.svg()

    @property
    def png(self) -> bytes:
        """The picture as PNG."""
        return self._native.png()

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes a file by its ending, ``.svg``, ``.png`` or ``.csv``; in a folder, an SVG with the picture's name.

        :returns: the path of the file.
        :raises ValueError: the ending is another one, or the picture has no CSV.
        """
        path = Path(path)
        if path.is_dir():
            path = path / f"{self.name}.svg"
        forms = {".svg": lambda: self.svg.encode(), ".png": lambda: self.png}
        if self.csv is not None:
            forms[".csv"] = lambda: (self.csv or "").encode()
        if path.suffix not in forms:
            raise ValueError(f"{path}: the name must end in one of {', '.join(forms)}")
        path.write_bytes(forms[path.suffix]())
        return path

    def _repr_svg_(self) -> str:
        return self.svg


def figures(
    tables: Table | Sequence[Table],
    *,
    x: str,
    y: str,
    by: str = "policy",
    where: Mapping[str, Setting] | None = None,
    log: Iterable[str] = (),
) -> list[Figure]:
    """Draws a metric of a sweep against a field, as ``reveille figures sweep`` does. It draws a picture for each
    combination of values of the other differing fields, at most 24.

    :param tables: one table or several, which are concatenated. PyArrow tables need PyArrow.
    :param x: the field along x, such as ``"devices"`` or ``"harvest.lambda"``; its values are numbers.
    :param y: the metric along y, such as ``"info_p1"``.
    :param by: the field that defines the lines; each of its values has a line.
    :param where: keep only runs with these values of these fields.
    :param log: the axes that are logarithmic: ``"x"``, ``"y"``, or both.
    :raises ValueError: unknown field, value or metric, too many lines or pictures (messages as in the command line), or
        unreadable table.
    """
    return _drawn(tables, x, y, by, where, log)[0]


def figure(
    tables: Table | Sequence[Table],
    *,
    x: str,
    y: str,
    by: str = "policy",
    where: Mapping[str, Setting] | None = None,
    log: Iterable[str] = (),
) -> Figure:
    """Draws a sweep metric as one picture; see :func:`figures` for the arguments.

    :raises ValueError: as in :func:`figures`, or there are several pictures; the message names the differing fields.
    """
    drawn, several = _drawn(tables, x, y, by, where, log)
    if several is not None:
        raise ValueError(f"{several}; use `where` to choose one, or reveille.figures for all")
    return drawn[0]


def _drawn(
    tables: Table | Sequence[Table],
    x: str,
    y: str,
    by: str,
    where: Mapping[str, Setting] | None,
    log: Iterable[str],
) -> tuple[list[Figure], str | None]:
    axes = list(log)
    if unknown := [axis for axis in axes if axis not in ("x", "y")]:
        raise ValueError(f"log: unknown axes {unknown}; the axes are `x` and `y`")
    if isinstance(tables, (str, os.PathLike)) or hasattr(tables, "schema"):
        tables = [tables]
    only = [(field, value if isinstance(value, str) else toml(value)) for field, value in (where or {}).items()]
    with tempfile.TemporaryDirectory() as folder:
        named = [_on_disk(table, at, Path(folder)) for at, table in enumerate(tables)]
        pictures, several = _native.sweep_pictures(named, x, y, by, only, ["x" in axes, "y" in axes])
    return [Figure(picture) for picture in pictures], several


def _on_disk(table: Table, at: int, folder: Path) -> tuple[str, Path]:
    """Returns the display name and the path of a table. Writes PyArrow tables to ``folder``."""
    if isinstance(table, (str, os.PathLike)):
        return os.fspath(table), Path(table)
    from pyarrow import parquet

    path = folder / f"{at}.parquet"
    parquet.write_table(table, path)
    return f"table {at}", path


def deployment_figure(
    scenario: str = "paper",
    *,
    event: int | None = None,
    policy: str | None = None,
    devices: int | None = None,
    ttis: int | None = None,
    battery_knowledge: str | None = None,
    seed: int | None = None,
    set: Mapping[str, Setting] | None = None,  # noqa: A002
) -> Figure:
    """Draws a deployment with each device's action at the end of an event, from a run made like :func:`reveille.run`.

    :param event: the event's number, from 0; by default the first event after the warm-up with several reports and a
        wake-up, else with a report, else the first event.
    :raises ValueError: the scenario is refused, there is no such event, or there are more devices than can be drawn.
    """
    changes = overrides(
        set, devices=devices, ttis=ttis, battery_knowledge=battery_knowledge, policy=policy, seed=seed
    )
    return Figure(_native.deployment_picture(scenario, changes, event))


def timeline_figure(
    scenario: str = "paper",
    *,
    show: Sequence[int] = (),
    first: int | None = None,
    length: int = 200,
    policy: str | None = None,
    devices: int | None = None,
    ttis: int | None = None,
    battery_knowledge: str | None = None,
    seed: int | None = None,
    set: Mapping[str, Setting] | None = None,  # noqa: A002
) -> Figure:
    """Draws batteries and states of some devices over time, from a run made like :func:`reveille.run`.

    :param show: numbers of devices, at most 8; by default the three busiest.
    :param first: the first TTI; by default the end of the warm-up.
    :param length: TTIs, 10 to 2000.
    :raises ValueError: the scenario is refused, or there are no such devices or TTIs.
    """
    changes = overrides(
        set, devices=devices, ttis=ttis, battery_knowledge=battery_knowledge, policy=policy, seed=seed
    )
    return Figure(_native.timeline_picture(scenario, changes, list(show), first, length))
