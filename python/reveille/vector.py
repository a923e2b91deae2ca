"""Many environments that step together, for Gymnasium."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from .environment import PARTS, SEEDS, Observation, make_batch, observation_space
from .scenario import Setting, overrides


class ReveilleVectorEnv(VectorEnv[Observation, NDArray[np.int8], NDArray[Any]]):
    """``num_envs`` environments like :class:`reveille.environment.ReveilleEnv`, stepped in Rust on ``threads`` threads
    while other Python threads may run.

    Observations have a leading axis of environments. With ``copy=False`` every step returns the same arrays and
    overwrites them.

    Autoreset happens in the next step: the step after the end of an episode ignores its action and starts the next
    episode, with reward 0.
    """

    def __init__(
        self,
        scenario: str = "paper",
        num_envs: int = 1,
        *,
        threads: int | None = None,
        autoreset: str = "next_step",
        copy: bool = True,
        devices: int | None = None,
        ttis: int | None = None,
        battery_knowledge: str | None = None,
        mu1: float = 14.0,
        mu2: float = 1.0,
        set: Mapping[str, Setting] | None = None,  # noqa: A002
        render_mode: str | None = None,
    ) -> None:
        """Makes the environments.

        :param num_envs: number of environments, ≥ 1.
        :param threads: number of threads; by default one per environment, at most the CPUs of this process.
        :param autoreset: ``"next_step"``, or ``"disabled"``: an ended environment then rests until a reset with
            ``options={"reset_mask": ...}``.
        :param copy: whether each step returns new arrays.

        The other parameters are as in :class:`reveille.environment.ReveilleEnv`.
        """
        modes = {"next_step": AutoresetMode.NEXT_STEP, "disabled": AutoresetMode.DISABLED}
        if autoreset not in modes:
            raise ValueError(f"autoreset {autoreset!r}: must be one of {sorted(modes)}")
        if num_envs < 1:
            raise ValueError(f"num_envs {num_envs}: must be at least 1")
        self.metadata = {"render_modes": [], "autoreset_mode": modes[autoreset]}
        self.render_mode = None
        self.num_envs = num_envs
        self.copy = copy
        self._autoresets = autoreset == "next_step"
        fields = {"devices": devices, "ttis": ttis, "battery_knowledge": battery_knowledge}
        threads = threads or min(num_envs, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
        self._batch = make_batch(scenario, set, fields, (mu1, mu2), render_mode, num_envs, threads)
        self._ended = np.zeros(num_envs, dtype=bool)
        self._changes: list[str] = []
        self._randoms = [np.random.default_rng() for _ in range(num_envs)]
        n = self._batch.n
        self.single_observation_space = observation_space(n)
        self.single_action_space = spaces.MultiBinary(n)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._false = np.zeros(num_envs, dtype=bool)

    def _observation(self) -> Observation:
        batch = self._batch
        arrays = {
            "device": batch.devices,
            "globals": batch.globals,
            "stage": batch.stage,
            "action_mask": batch.mask,
        }
        return {key: array.copy() for key, array in arrays.items()} if self.copy else arrays

    def _begin(self, which: Sequence[int], seeds: Sequence[int | None]) -> None:
        drawn = []
        for at, seed in zip(which, seeds, strict=True):
            if seed is not None:
                # Like a single environment: later seeds follow from this one.
                self._randoms[at] = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
            drawn.append(int(self._randoms[at].integers(SEEDS)) if seed is None else seed)
        self._batch.reset(list(which), drawn, self._changes)
        self._ended[list(which)] = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts a run in each environment.

        :param seed: a list with one seed for each, or a number s for s, s + 1, ...; a missing seed is drawn.
        :param options: ``"set"`` as in :meth:`reveille.environment.ReveilleEnv.reset`, kept until it is set again;
            ``"reset_mask"``, a truth value for each environment, limits the reset to these.
        """
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        if "set" in options:
            self._changes = overrides(options.pop("set"))
        if options:
            raise ValueError(f"options: unknown keys {sorted(options)}; use `set` and `reset_mask`")
        which = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + at for at in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: {len(seeds)} seeds for {self.num_envs} environments; give one for each")
        self._begin([int(at) for at in which], [seeds[at] for at in which])
        return self._observation(), {}

    def step(
        self, actions: NDArray[np.int8]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Applies a decision in each environment.

        :param actions: zeros and ones, (K, N).
        :raises ValueError: the actions have another shape.
        """
        rests = self._ended.copy()
        rows = np.ascontiguousarray(actions)
        if rows.dtype != np.int8:
            rows = rows.astype(bool).astype(np.int8)
        if rows.ndim != 2:
            raise ValueError(f"actions of shape {rows.shape}: must be ({self.num_envs}, {self._batch.n})")
        if self._autoresets and rests.any():
            begins = np.flatnonzero(rests)
            self._begin([int(at) for at in begins], [None] * len(begins))
        self._batch.step(rows, rests)
        self._ended = self._batch.ended.copy()
        info = self._info(rests)
        return self._observation(), self._batch.reward.copy(), self._false.copy(), self._ended.copy(), info

    def _info(self, rests: NDArray[np.bool_]) -> dict[str, Any]:
        batch = self._batch
        info: dict[str, Any] = {name: batch.parts[:, at].copy() for at, name in enumerate(PARTS)}
        info["tti"] = batch.ttis.copy()
        ends = self._ended & ~rests
        if ends.any():
            for key in ("digest", "metrics", "policy_facts", "ttis_done", "complete"):
                info[key] = np.full(self.num_envs, None, dtype=object)
                info[f"_{key}"] = ends.copy()
            for at in np.flatnonzero(ends):
                for key, value in batch.outcome(int(at)).items():
                    info[key][at] = value
        return info
