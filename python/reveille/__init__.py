"""Reveille for Python: environments to train policies in, runs and sweeps.

The paper's system is in the compiled module: devices on harvested energy, events, wake-up radios, the base station.
What is seen and rewarded here is what a base station could know and what the paper rewards.

- :class:`~reveille.environment.ReveilleEnv` for Gymnasium, registered as ``Reveille-v0``;
- :func:`make_vec`: many of them, stepped on threads of their own;
- :func:`parallel_env` for PettingZoo: each device an agent;
- :func:`run` and :func:`sweep`: the policies of the program;
- :class:`PolicyClient` and :func:`decide`: what was trained decides for a run of the emulator.

Gymnasium, PettingZoo, PyArrow and eclipse-zenoh are needed by the parts that use them alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .port import PolicyClient, PortError, decide
from .runs import policies, run, sweep
from .scenario import DEVICE_FEATURES, GLOBAL_FEATURES, Feature, Setting

if TYPE_CHECKING:
    from .environment import ReveilleEnv
    from .multiagent import ReveilleParallelEnv
    from .vector import ReveilleVectorEnv

__all__ = [
    "DEVICE_FEATURES",
    "GLOBAL_FEATURES",
    "Feature",
    "PolicyClient",
    "PortError",
    "Setting",
    "decide",
    "make",
    "make_vec",
    "parallel_env",
    "policies",
    "run",
    "sweep",
]


def make(scenario: str = "paper", **settings: Any) -> ReveilleEnv:
    """One environment, as ``gymnasium.make("Reveille-v0", ...)`` makes it but without wrappers."""
    from .environment import ReveilleEnv

    return ReveilleEnv(scenario, **settings)


def make_vec(scenario: str = "paper", num_envs: int = 1, **settings: Any) -> ReveilleVectorEnv:
    """Many environments that step together. See :class:`reveille.vector.ReveilleVectorEnv`."""
    from .vector import ReveilleVectorEnv

    return ReveilleVectorEnv(scenario, num_envs, **settings)


def parallel_env(scenario: str = "paper", **settings: Any) -> ReveilleParallelEnv:
    """Each device an agent. See :class:`reveille.multiagent.ReveilleParallelEnv`."""
    from .multiagent import ReveilleParallelEnv

    return ReveilleParallelEnv(scenario, **settings)


def _register() -> None:
    try:
        import gymnasium  # noqa: F401
    except ImportError:
        return
    from .registration import register

    register()


_register()
