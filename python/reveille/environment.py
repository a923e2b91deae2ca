"""One environment, for Gymnasium."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from . import _native
from .scenario import DEVICE_FEATURES, GLOBAL_FEATURES, Setting, overrides

#: The parts of a reward, in the order of the compiled module.
PARTS = ("asleep", "missed", "information", "woken")
#: Exclusive upper bound of drawn seeds.
SEEDS = 2**31 - 1

Observation = dict[str, Any]


def observation_space(n: int) -> spaces.Dict:
    """Returns the observation space of ``n`` devices."""
    return spaces.Dict(
        {
            "device": spaces.Box(0.0, 1.0, (n, len(DEVICE_FEATURES)), np.float32),
            "globals": spaces.Box(0.0, 1.0, (len(GLOBAL_FEATURES),), np.float32),
            "stage": spaces.Discrete(2),
            "action_mask": spaces.Box(0, 2, (n,), np.int8),
        }
    )


def make_batch(
    scenario: str,
    set: Mapping[str, Setting] | None,  # noqa: A002
    fields: Mapping[str, Setting | None],
    weights: tuple[float, float],
    render_mode: str | None,
    num_envs: int = 1,
    threads: int = 1,
) -> _native.Batch:
    """Makes the environments in Rust from the arguments shared by all environment classes. ``fields`` override ``set``.

    :raises ValueError: the scenario is refused, or a render mode is given.
    """
    if render_mode is not None:
        raise ValueError(f"render_mode {render_mode!r}: must be None, as environments draw nothing")
    return _native.Batch(scenario, overrides(set, **fields), list(range(num_envs)), threads, *weights)


def parts(batch: _native.Batch, at: int) -> dict[str, Any]:
    """Returns the ``info`` entries of the last step of environment ``at``."""
    row = batch.parts[at]
    told: dict[str, Any] = {name: float(value) for name, value in zip(PARTS, row, strict=True)}
    told["tti"] = int(batch.ttis[at])
    return told


class Snapshot:
    """Saved state of an environment. See :meth:`ReveilleEnv.snapshot`."""

    __slots__ = ("_native",)

    def __init__(self, native: _native.Snapshot) -> None:
        self._native = native


class ReveilleEnv(gym.Env[Observation, NDArray[np.int8]]):
    """Environment whose steps are the base station's decisions in a run.

    At **stage 0** the action is δ(k): bit j tells device j to sense in TTI k. **Stage 1** follows a report in TTI k,
    and its action is the set of devices to wake, in the order of ids. The stage repeats until the action is all zeros
    or no device is left to wake. Devices that were instructed to sense, or were woken in this TTI, are not woken: their
    bits are dropped without an error.

    An episode is a run of ``ttis`` TTIs. It is truncated at its end, never terminated.

    Observation: a dictionary.

    ==============  ==================  ==========================================================================
    key             shape and type      meaning
    ==============  ==================  ==========================================================================
    ``device``      (N, F) float32      :data:`reveille.DEVICE_FEATURES` of each device, in [0, 1]
    ``globals``     (G,) float32        :data:`reveille.GLOBAL_FEATURES`, in [0, 1]
    ``stage``       int64               0 or 1
    ``action_mask`` (N,) int8           2: either bit; 0: a 1 would be dropped. ``action_space.sample`` takes it
    ==============  ==================  ==========================================================================

    The observation holds only information available to a base station; with ``battery_knowledge="reported"`` it holds
    no true battery levels.

    The reward at stage 0 is the paper's r(k): the share of sleeping devices minus α μ1 times the share of the area
    without a sensing device. That share is the probability that an event that starts in TTI k is missed in it. The
    reward at stage 1 is this action's share of r*(k): μ2 times the gain of Î, as a share of Ψ, minus 1/N for each woken
    device.

    ``info`` holds the parts of the reward (``asleep``, ``missed``, ``information``, ``woken``), which add up to it, and
    ``tti``, the number of closed TTIs. In the last step it also holds ``digest``, ``metrics``, ``policy_facts``,
    ``ttis_done`` and ``complete`` of the run.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(
        self,
        scenario: str = "paper",
        *,
        devices: int | None = None,
        ttis: int | None = None,
        battery_knowledge: str | None = None,
        mu1: float = 14.0,
        mu2: float = 1.0,
        set: Mapping[str, Setting] | None = None,  # noqa: A002
        render_mode: str | None = None,
    ) -> None:
        """Makes an environment.

        :param scenario: a preset, such as ``"paper"``, or a scenario file.
        :param devices: number of devices N.
        :param ttis: length of an episode K, TTIs.
        :param battery_knowledge: ``"reported"`` or ``"oracle"``.
        :param mu1: weight μ1 of misdetections in the reward, ≥ 0.
        :param mu2: weight μ2 of information in the reward, ≥ 0.
        :param set: fields of the scenario by their paths, such as ``{"harvest.lambda": 0.2}``.
        :param render_mode: must be ``None``; the environment draws nothing.
        :raises ValueError: the scenario is refused; the message names the field and the allowed values.
        """
        fields = {"devices": devices, "ttis": ttis, "battery_knowledge": battery_knowledge}
        self._batch = make_batch(scenario, set, fields, (mu1, mu2), render_mode)
        self.render_mode = None
        self._is_begun = False
        self._rests = np.zeros(1, dtype=bool)
        self.observation_space = observation_space(self._batch.n)
        self.action_space = spaces.MultiBinary(self._batch.n)

    def _observation(self) -> Observation:
        batch = self._batch
        return {
            "device": batch.devices[0].copy(),
            "globals": batch.globals[0].copy(),
            "stage": np.int64(batch.stage[0]),
            "action_mask": batch.mask[0].copy(),
        }

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts a run.

        :param seed: the scenario's seed, which also determines seeds drawn later; drawn if None.
        :param options: ``{"set": {...}}`` sets fields for this episode, in addition to the environment's fields. The
            number of devices cannot change.
        """
        super().reset(seed=seed)
        extra = set(options or {}) - {"set"}
        if extra:
            raise ValueError(f"options: unknown keys {sorted(extra)}; use `set`")
        drawn = int(self.np_random.integers(SEEDS)) if seed is None else seed
        changes = overrides((options or {}).get("set"))
        self._batch.reset([0], [drawn], changes)
        self._is_begun = True
        return self._observation(), {"seed": drawn, "tti": 0}

    def step(self, action: NDArray[np.int8]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Applies a decision.

        :param action: N zeros and ones.
        :raises ValueError: the action has another shape.
        """
        if not self._is_begun:
            raise gym.error.ResetNeeded("reset the environment before its first step")
        row = np.ascontiguousarray(action).astype(bool).astype(np.int8).reshape(1, -1)
        self._batch.step(row, self._rests)
        ended = bool(self._batch.ended[0])
        info = parts(self._batch, 0)
        if ended:
            info.update(self._batch.outcome(0))
        return self._observation(), float(self._batch.reward[0]), False, ended, info

    def snapshot(self) -> Snapshot:
        """Saves the state of the run for :meth:`restore`, without random number generators."""
        return Snapshot(self._batch.snapshot(0))

    def restore(self, snapshot: Snapshot) -> Observation:
        """Restores the state of ``snapshot``, in this environment or another with the same number of devices. A
        snapshot can be restored any number of times."""
        self._batch.restore(0, snapshot._native)
        self._is_begun = True
        return self._observation()
