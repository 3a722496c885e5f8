"""The public names: what `import dipn_jax` offers, and that it does nothing else."""

import importlib
import inspect
import itertools
import os
import pathlib
import subprocess
import sys
import textwrap
from typing import Any, get_args

import jax
import numpy as np
import pytest
from flax import nnx

import dipn_jax
from dipn_jax.names import MethodName
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.planning import methods, predictors
from dipn_jax.planning.policy_config import PolicyConfig
from dipn_jax.storage import checkpoint
from dipn_jax.world.cases import hard_cases_path

DIPN = DipnConfig(width=8)


def test_every_public_name_exists_and_shows_its_use() -> None:
    assert 15 <= len(dipn_jax.__all__) <= 20 and sorted(dipn_jax.__all__) == dipn_jax.__all__
    assert set(dipn_jax.__all__) == set(dipn_jax._HOME) <= set(dir(dipn_jax))
    for name in dipn_jax.__all__:
        item = getattr(dipn_jax, name)
        home = importlib.import_module(dipn_jax._HOME[name])
        assert getattr(home, name) is item
        assert item.__doc__ and f"dipn_jax.{name}" in item.__doc__, f"{name}: its docstring shows no use"


def test_every_method_that_commands_name_is_one_entry_of_the_registry() -> None:
    assert tuple(methods.METHODS) == get_args(MethodName)
    assert {name for name, method in methods.METHODS.items() if method.needs_state} == {"physics+gn"}


def _snippet(text: str) -> str:
    """Return the code of a docstring's section `Example`."""
    lines = inspect.cleandoc(text).split("Example:\n")[1].splitlines()
    return textwrap.dedent("\n".join(itertools.takewhile(lambda line: not line or line.startswith(" "), lines)))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Return a folder of two runs, of networks with random weights."""
    runs = tmp_path_factory.mktemp("runs")
    for run, name, config in (("gn", "grasp", GraspConfig(width=8, coarse=8, blocks=1)), ("dipn", "dipn", DIPN)):
        model = checkpoint.build(name, config)
        checkpoint.save(runs / run, 1, {"model": nnx.state(model)}, network=name, config=config, extra={})
    return runs


DECIDING = ("Decision", "decide", "load_policy")
"""Names whose use compiles a policy, which takes ten seconds each."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in DECIDING)) for name in dipn_jax.__all__]
)
def test_the_use_that_a_docstring_shows_runs(
    name: str, settled: Any, data: Any, trained: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a reader would type it, with what the text before it has made."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").symlink_to(data["push"].parent)
    (tmp_path / "runs").symlink_to(trained)
    (tmp_path / "mine.json").write_bytes(hard_cases_path().read_bytes())
    observation = dipn_jax.render(settled.scene[0], settled.poses[0])
    known = {
        "dipn_jax": dipn_jax, "jax": jax, "np": np, "key": jax.random.key(0), "observation": observation,
        "motion": np.zeros((5, 3), np.float32), "predictor": predictors.static_predictor,
        "scorer": lambda images: images[:, None, :, :, 3].repeat(16, 1),
        "height": observation.height, "color": observation.color, "label": observation.label,
        "policy": dipn_jax.load_policy("gn"),
    }  # fmt: skip
    exec(_snippet(getattr(dipn_jax, name).__doc__), known)


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


def test_policies_of_the_shipped_networks_share_what_is_compiled_unless_their_aids_differ() -> None:
    one = methods.load_policy("dipn+gn")
    other = methods.load_policy("dipn+gn", config=PolicyConfig(gamma=0.5, candidates=4))
    assert other.decide_function is one.decide_function and other.rule.gamma == 0.5 and len(other.distances) == 4
    bare = methods.load_policy("dipn+gn", config=PolicyConfig(aids=()))
    assert bare.decide_function is not one.decide_function and bare.rule.draw_all


@pytest.mark.slow
def test_a_policy_is_loaded_by_its_name(settled: Any) -> None:
    """`gn` chooses the best grasp of the shipped network, and so does `dipn+gn` where it does not push."""
    observation = dipn_jax.render(settled.scene[0], settled.poses[0])
    grasping = dipn_jax.load_policy("gn")(jax.random.key(0), observation)
    both = dipn_jax.load_policy("dipn+gn")(jax.random.key(0), observation)
    assert not grasping.is_push and not both.is_push
    np.testing.assert_array_equal(grasping.grasp_pixel, both.grasp_pixel)
    _, row, col = grasping.grasp_pixel
    assert observation.label[row, col] >= 0, "it grasps an object"


def test_a_policy_that_cannot_be_loaded_is_one_line() -> None:
    with pytest.raises(dipn_jax.UserError, match=r"--method vpg: needs --value-net \(in Python value_net\)"):
        dipn_jax.load_policy("vpg")
    with pytest.raises(dipn_jax.UserError, match=r"physics.gn: decides on the simulator's state"):
        dipn_jax.load_policy("physics+gn")
    with pytest.raises(dipn_jax.UserError, match=r"--method dip: want one of dipn.gn"):
        dipn_jax.load_policy("dip")  # type: ignore[arg-type]
