"""Registration of the environment in Gymnasium."""

from __future__ import annotations


def register() -> None:
    """Registers ``Reveille-v0`` unless it is registered already."""
    from gymnasium.envs.registration import register as add
    from gymnasium.envs.registration import registry

    if "Reveille-v0" not in registry:
        add(
            id="Reveille-v0",
            entry_point="reveille.environment:ReveilleEnv",
            vector_entry_point="reveille.vector:ReveilleVectorEnv",
            order_enforce=True,
        )
