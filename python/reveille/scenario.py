"""Scenario fields, their overrides, and the features of observations."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

from . import _native

#: The value of a scenario's field, as in TOML.
Setting: TypeAlias = "bool | int | float | str | Sequence[Setting]"


class Feature(NamedTuple):
    """A number in [0, 1] in an observation."""

    name: str
    about: str


#: The features of ``observation["device"][j]``, in order.
DEVICE_FEATURES: tuple[Feature, ...] = tuple(Feature(*pair) for pair in _native.features()[0])
#: The features of ``observation["globals"]``, in order.
GLOBAL_FEATURES: tuple[Feature, ...] = tuple(Feature(*pair) for pair in _native.features()[1])

#: The index of each feature in its array, by name: ``observation["device"][:, DEVICE_COLUMNS["battery"]]``.
DEVICE_COLUMNS: dict[str, int] = {feature.name: at for at, feature in enumerate(DEVICE_FEATURES)}
GLOBAL_COLUMNS: dict[str, int] = {feature.name: at for at, feature in enumerate(GLOBAL_FEATURES)}


def toml(value: Setting) -> str:
    """Formats ``value`` as TOML."""
    if hasattr(value, "item"):  # a NumPy number
        return toml(value.item())
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, Sequence):
        return "[" + ", ".join(toml(part) for part in value) + "]"
    raise TypeError(f"{value!r}: not a field value; use a number, a string, a truth value or a list of them")


def overrides(
    changes: Mapping[str, Setting] | None,
    *,
    devices: int | None = None,
    ttis: int | None = None,
    battery_knowledge: str | None = None,
    policy: str | None = None,
    seed: int | None = None,
) -> list[str]:
    """Returns the fields to set as ``path=value``. Named arguments follow and override ``changes``."""
    named: dict[str, Setting | None] = {
        "devices": devices,
        "ttis": ttis,
        "bs.battery_knowledge": battery_knowledge,
        "policy.name": policy,
        "seed": seed,
    }
    if not isinstance(changes, (Mapping, type(None))):
        raise TypeError(f"set: {changes!r} must be a mapping from field paths to values")
    given = dict(changes or {})
    given.update({path: value for path, value in named.items() if value is not None})
    return [f"{path}={toml(value)}" for path, value in given.items()]
