"""The public names: what `import dipn_jax` offers, and that it does nothing else."""

import importlib
import os
import subprocess
import sys
from typing import Any

import jax
import numpy as np
import pytest

import dipn_jax


def test_every_public_name_exists_and_shows_its_use() -> None:
    assert 15 <= len(dipn_jax.__all__) <= 18 and sorted(dipn_jax.__all__) == dipn_jax.__all__
    assert set(dipn_jax.__all__) == set(dipn_jax._HOME) <= set(dir(dipn_jax))
    for name in dipn_jax.__all__:
        item = getattr(dipn_jax, name)
        home = importlib.import_module(dipn_jax._HOME[name])
        assert getattr(home, name) is item
        assert item.__doc__ and f"dipn_jax.{name}" in item.__doc__, f"{name}: its docstring shows no use"


def test_another_name_is_an_error_that_lists_them() -> None:
    with pytest.raises(AttributeError, match="no attribute 'clear'; it has Decision, Grasp"):
        dipn_jax.clear  # noqa: B018


def test_importing_does_nothing() -> None:
    script = (
        "import os, sys; before, known = dict(os.environ), set(sys.modules); import dipn_jax; "
        "assert dict(os.environ) == before; new = {name.split('.')[0] for name in set(sys.modules) - known}; "
        "assert not new & {'jax', 'jaxlib', 'numpy', 'mujoco', 'flax', 'matplotlib', 'tyro', 'beartype'}, new"
    )
    subprocess.run([sys.executable, "-c", script], check=True, env=dict(os.environ))


def test_structs_are_indexed_by_row(settled: Any) -> None:
    third, some = settled.scene[2], settled.scene[np.array([4, 1])]
    np.testing.assert_array_equal(third.size, settled.scene.size[2])
    np.testing.assert_array_equal(some.mass, settled.scene.mass[[4, 1]])
    seen = jax.vmap(dipn_jax.render)(settled.scene, settled.poses)
    assert seen[1].slots == 5 and seen[1].height.shape == (224, 224)


def test_a_policy_is_loaded_by_its_name(settled: Any) -> None:
    """`gn` chooses the best grasp of the shipped network, and so does `dipn+gn` where it does not push."""
    observation = dipn_jax.render(settled.scene[0], settled.poses[0])
    grasping = dipn_jax.load_policy("gn")(jax.random.key(0), observation)
    both = dipn_jax.load_policy("dipn+gn")(jax.random.key(0), observation)
    assert not grasping.is_push and not both.is_push
    np.testing.assert_array_equal(grasping.grasp_pixel, both.grasp_pixel)
    _, row, col = grasping.grasp_pixel
    assert observation.label[row, col] >= 0, "it grasps an object"
    with pytest.raises(dipn_jax.UserError, match="--method vpg: needs --value-net"):
        dipn_jax.load_policy("vpg")
    with pytest.raises(dipn_jax.UserError, match=r"physics.gn: decides on the simulator's state"):
        dipn_jax.load_policy("physics+gn")
    with pytest.raises(dipn_jax.UserError, match=r"--method dip: want one of dipn.gn"):
        dipn_jax.load_policy("dip")  # type: ignore[arg-type]
