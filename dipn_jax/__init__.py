"""Push and grasp episodes, DIPN and GN, and clutter clearing in JAX and MuJoCo.

    import jax
    import dipn_jax

    names, scenes, poses = dipn_jax.load_cases()
    observation = dipn_jax.render(scenes[0], poses[0])
    policy = dipn_jax.load_policy("dipn+gn")
    decision = policy(jax.random.key(0), observation)

The names below are what most users need; everything else is reached by its module, such as `dipn_jax.world.shapes`.
They are imported when they are first used, so `import dipn_jax` by itself costs nothing.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dipn_jax.errors import UserError
    from dipn_jax.physics import make_engine
    from dipn_jax.planning.memory import MissedGrasps
    from dipn_jax.planning.methods import load_policy
    from dipn_jax.planning.planner import decide
    from dipn_jax.planning.policy_config import PolicyConfig
    from dipn_jax.sight.imagine import imagine
    from dipn_jax.sight.observed import check_observation
    from dipn_jax.sight.render import render
    from dipn_jax.storage.checkpoint import load_network
    from dipn_jax.storage.records import read_episodes
    from dipn_jax.structs import Decision, Grasp, Observation, Push, Scene
    from dipn_jax.world.cases import load_cases
    from dipn_jax.world.clutter import settled_scenes
    from dipn_jax.world.scenes import SceneConfig

__all__ = [
    "Decision",
    "Grasp",
    "MissedGrasps",
    "Observation",
    "PolicyConfig",
    "Push",
    "Scene",
    "SceneConfig",
    "UserError",
    "check_observation",
    "decide",
    "imagine",
    "load_cases",
    "load_network",
    "load_policy",
    "make_engine",
    "read_episodes",
    "render",
    "settled_scenes",
]

_MODULES = {
    "errors": ("UserError",),
    "structs": ("Decision", "Grasp", "Observation", "Push", "Scene"),
    "physics": ("make_engine",),
    "planning.memory": ("MissedGrasps",),
    "planning.methods": ("load_policy",),
    "planning.planner": ("decide",),
    "planning.policy_config": ("PolicyConfig",),
    "sight.imagine": ("imagine",),
    "sight.observed": ("check_observation",),
    "sight.render": ("render",),
    "storage.checkpoint": ("load_network",),
    "storage.records": ("read_episodes",),
    "world.cases": ("load_cases",),
    "world.clutter": ("settled_scenes",),
    "world.scenes": ("SceneConfig",),
}
_HOME = {name: f"dipn_jax.{module}" for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name from its module when it is first used, and return it."""
    if name == "__version__":
        return importlib.metadata.version("dipn-jax")
    if name not in _HOME:
        raise AttributeError(f"module 'dipn_jax' has no attribute {name!r}; it has {', '.join(__all__)}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
