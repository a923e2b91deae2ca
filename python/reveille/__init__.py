"""Reveille for Python: environments to train policies in, runs and sweeps.

The paper's system is in the compiled module: devices on harvested energy, events, wake-up radios, the base station.
What is seen and rewarded here is what a base station could know and what the paper rewards.

- :class:`~reveille.environment.ReveilleEnv` for Gymnasium, registered as ``Reveille-v0``;
- :func:`make_vec`: many of them, stepped on threads of their own;
- :func:`parallel_env` for PettingZoo: each device an agent;
- :func:`run` and :func:`sweep`: the policies of the program;
- :func:`record_trajectories`, :class:`Trajectories` and :func:`to_minari`: runs in the environment, step by step, in
  Parquet files and as Minari datasets;
- :func:`figure`, :func:`figures`, :func:`deployment_figure` and :func:`timeline_figure`: pictures, as SVG and PNG;
- :class:`PolicyClient` and :func:`decide`: what was trained decides for a run of the emulator.

Gymnasium, PettingZoo, PyArrow, Minari and eclipse-zenoh are needed by the parts that use them alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .pictures import Figure, deployment_figure, figure, figures, timeline_figure
from .port import PolicyClient, PortError, Question, decide
from .runs import policies, run, sweep
from .scenario import DEVICE_FEATURES, GLOBAL_FEATURES, Feature, Setting

if TYPE_CHECKING:
    from .environment import ReveilleEnv
    from .multiagent import ReveilleParallelEnv
    from .trajectories import Trajectories, record_trajectories, to_minari
    from .vector import ReveilleVectorEnv

__all__ = [
    "DEVICE_FEATURES",
    "GLOBAL_FEATURES",
    "Feature",
    "Figure",
    "PolicyClient",
    "PortError",
    "Question",
    "Setting",
    "Trajectories",
    "decide",
    "deployment_figure",
    "figure",
    "figures",
    "make",
    "make_vec",
    "parallel_env",
    "policies",
    "record_trajectories",
    "run",
    "sweep",
    "timeline_figure",
    "to_minari",
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


def __getattr__(name: str) -> Any:
    # They need Gymnasium as they are read.
    if name in ("Trajectories", "record_trajectories", "to_minari"):
        from . import trajectories

        return getattr(trajectories, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _register() -> None:
    try:
        import gymnasium  # noqa: F401
    except ImportError:
        return
    from .registration import register

    register()


_register()
