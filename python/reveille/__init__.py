"""Reveille for Python: environments to train policies in, runs and sweeps.

The compiled module contains the paper's system: devices on harvested energy, events, wake-up radios and the base
station. Observations hold only information available to a base station, and rewards are the paper's.

- :class:`~reveille.environment.ReveilleEnv` for Gymnasium, registered as ``Reveille-v0``;
- :func:`make_vec`: many environments, stepped on their own threads;
- :func:`parallel_env` for PettingZoo, with an agent for each device;
- :func:`run` and :func:`sweep`: runs of the built-in policies;
- :func:`record_trajectories`, :class:`Trajectories` and :func:`to_minari`: environment runs, step by step, in Parquet
  files and as Minari datasets;
- :func:`figure`, :func:`figures`, :func:`deployment_figure` and :func:`timeline_figure`: pictures, as SVG and PNG;
- :class:`PolicyClient` and :func:`decide`: a trained policy decides for a run of the emulator.

Gymnasium, PettingZoo, PyArrow, Minari and eclipse-zenoh are needed only by the parts that use them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .figures import Figure, deployment_figure, figure, figures, timeline_figure
from .policy_client import PolicyClient, PortError, Question, decide
from .runs import policies, run, sweep
from .scenario import DEVICE_COLUMNS, DEVICE_FEATURES, GLOBAL_COLUMNS, GLOBAL_FEATURES, Feature, Setting

if TYPE_CHECKING:
    from .environment import ReveilleEnv
    from .multiagent import ReveilleParallelEnv
    from .trajectories import Trajectories, record_trajectories, to_minari
    from .vector import ReveilleVectorEnv

__all__ = [
    "DEVICE_COLUMNS",
    "DEVICE_FEATURES",
    "GLOBAL_COLUMNS",
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
    """Makes one environment without the wrappers of ``gymnasium.make("Reveille-v0", ...)``."""
    from .environment import ReveilleEnv

    return ReveilleEnv(scenario, **settings)


def make_vec(scenario: str = "paper", num_envs: int = 1, **settings: Any) -> ReveilleVectorEnv:
    """Makes many environments that step together. See :class:`reveille.vector.ReveilleVectorEnv`."""
    from .vector import ReveilleVectorEnv

    return ReveilleVectorEnv(scenario, num_envs, **settings)


def parallel_env(scenario: str = "paper", **settings: Any) -> ReveilleParallelEnv:
    """Makes an environment with an agent for each device. See :class:`reveille.multiagent.ReveilleParallelEnv`."""
    from .multiagent import ReveilleParallelEnv

    return ReveilleParallelEnv(scenario, **settings)


def __getattr__(name: str) -> Any:
    # The trajectories module imports Gymnasium, so it loads on first use.
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
