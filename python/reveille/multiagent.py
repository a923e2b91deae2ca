"""PettingZoo environment with an agent for each device."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from pettingzoo import ParallelEnv

from .environment import SEEDS, Observation, make_batch, parts
from .scenario import DEVICE_FEATURES, GLOBAL_FEATURES, Setting, overrides


class ReveilleParallelEnv(ParallelEnv[str, Observation, int]):
    """Multi-agent form of :class:`reveille.environment.ReveilleEnv`: agents ``device_0``, ``device_1``, …, with one
    reward shared by all.

    An agent's action is its bit: whether to sense at stage 0, and whether to be woken at stage 1. It observes its row
    of ``device``, the ``globals`` and the ``stage``. Its ``action_mask``, (2,) int8, marks the bits that are not
    dropped. A device with an empty battery remains an agent, since it harvests and may recover. All agents end
    together, with the run.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "reveille_v0", "render_modes": [], "is_parallelizable": True}

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
        """Makes an environment with the arguments of :class:`reveille.environment.ReveilleEnv`."""
        fields = {"devices": devices, "ttis": ttis, "battery_knowledge": battery_knowledge}
        self._batch = make_batch(scenario, set, fields, (mu1, mu2), render_mode)
        self.render_mode = None
        self._rests = np.zeros(1, dtype=bool)
        self._random, _ = seeding.np_random()
        self.possible_agents = [f"device_{j}" for j in range(self._batch.n)]
        self.agents: list[str] = []
        # Every call returns the same objects, since frameworks look spaces up repeatedly and seed them.
        self.observation_spaces = {agent: _space() for agent in self.possible_agents}
        self.action_spaces = {agent: spaces.Discrete(2) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> spaces.Dict:
        """Returns the observation space of ``agent``."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Discrete:
        """Returns the action space of ``agent``: 0 or 1."""
        return self.action_spaces[agent]

    def _observations(self) -> dict[str, Observation]:
        batch = self._batch
        rows, stage = batch.devices[0].copy(), np.int64(batch.stage[0])
        common = batch.globals[0]
        mask = np.ones((len(rows), 2), dtype=np.int8)
        mask[:, 1] = batch.mask[0] > 0
        return {
            agent: {"device": rows[j], "globals": common.copy(), "stage": stage, "action_mask": mask[j]}
            for j, agent in enumerate(self.possible_agents)
        }

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Starts a run, as :meth:`reveille.environment.ReveilleEnv.reset` does."""
        if seed is not None:
            self._random, _ = seeding.np_random(seed)
        drawn = int(self._random.integers(SEEDS)) if seed is None else seed
        self._batch.reset([0], [drawn], overrides((options or {}).get("set")))
        self.agents = list(self.possible_agents)
        return self._observations(), {agent: {} for agent in self.agents}

    def step(
        self, actions: Mapping[str, int]
    ) -> tuple[
        dict[str, Observation],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Applies a decision. The action of a missing agent is 0."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        row = np.array([[int(bool(actions.get(agent, 0))) for agent in self.possible_agents]], dtype=np.int8)
        self._batch.step(row, self._rests)
        ended, reward = bool(self._batch.ended[0]), float(self._batch.reward[0])
        told = parts(self._batch, 0)
        if ended:
            told.update(self._batch.outcome(0))
        agents, observations = self.agents, self._observations()
        self.agents = [] if ended else agents
        return (
            observations,
            dict.fromkeys(agents, reward),
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, ended),
            {agent: dict(told) for agent in agents},
        )

    def render(self) -> None:
        """Does nothing; the environment draws nothing."""

    def close(self) -> None:
        """Does nothing; the environment holds no resources."""


def _space() -> spaces.Dict:
    return spaces.Dict(
        {
            "device": spaces.Box(0.0, 1.0, (len(DEVICE_FEATURES),), np.float32),
            "globals": spaces.Box(0.0, 1.0, (len(GLOBAL_FEATURES),), np.float32),
            "stage": spaces.Discrete(2),
            "action_mask": spaces.Box(0, 1, (2,), np.int8),
        }
    )
