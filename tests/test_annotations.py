"""Shapes in annotations: all of them can be evaluated and are checked in tests, and only there."""

import importlib
import inspect
import pkgutil
import subprocess
import sys
import textwrap
import typing
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

import dipn_jax
from dipn_jax.sight import render
from dipn_jax.structs import Fault, Push, Scene


def _scene(n: int) -> Scene:
    return Scene(np.zeros(n, np.int32), np.full((n, 3), 0.05), np.zeros((n, 3)), np.ones(n), np.ones(n))


def _poses(n: int) -> np.ndarray:
    return np.tile(np.array([0, 0, 0.025, 1, 0, 0, 0], np.float32), (n, 1))


def test_a_wrong_shape_is_an_error() -> None:
    render.render(_scene(2), _poses(2), pixels=64)
    with pytest.raises(TypeCheckError, match="poses"):
        render.render(_scene(2), _poses(2)[:, :6], pixels=64)
    with pytest.raises(TypeCheckError, match="poses"):
        render.render(_scene(2), _poses(3), pixels=64)  # of another number of objects
    with pytest.raises(TypeCheckError, match="label"):
        render.paint_labels(jnp.zeros((4, 4)), jnp.zeros((2, 3)))  # of another type


def test_fields_of_a_struct_fit_together() -> None:
    with pytest.raises(TypeCheckError, match="size"):
        Scene(np.zeros(2, np.int32), np.zeros((3, 3)), np.zeros((2, 3)), np.ones(2), np.ones(2))
    with pytest.raises(TypeCheckError, match="angle"):
        Push(np.zeros((4, 2)), np.zeros(3), np.zeros(4))


def test_jax_may_rebuild_structs_around_anything() -> None:
    scene = _scene(2)
    assert jax.tree.map(np.shape, scene).size == (2, 3)
    assert jax.tree.map(lambda _: None, scene).mass is None
    assert jax.eval_shape(lambda s: s, scene).size.shape == (2, 3)
    batch = jax.tree.map(lambda leaf: np.stack([leaf] * 3), scene)
    assert jax.vmap(lambda s: s.mass.sum(), in_axes=(Scene(0, 0, 0, 0, 0),))(batch).shape == (3,)


def _annotated() -> Iterator[tuple[str, Any]]:
    """Return everything in the package that has annotations."""
    for info in pkgutil.walk_packages(dipn_jax.__path__, "dipn_jax."):
        module = importlib.import_module(info.name)
        for name, item in vars(module).items():
            members = [item, *vars(item).values()] if inspect.isclass(item) else [item]
            for member in members:
                plain = inspect.unwrap(getattr(member, "__func__", member))
                known = inspect.isclass(plain) or inspect.isfunction(plain)
                if known and plain.__module__ == info.name:
                    yield f"{info.name}.{name}", plain


def test_every_annotation_can_be_evaluated() -> None:
    """One that cannot is silently not checked. Commands name types that they import late: no shapes."""
    found = list(_annotated())
    assert len(found) > 500
    for name, item in found:
        try:
            typing.get_type_hints(item, include_extras=True)
        except Exception as error:
            if isinstance(error, NameError) and not any("Array" in str(hint) for hint in item.__annotations__.values()):
                continue
            raise AssertionError(f"{name}: {error}") from error


@pytest.mark.slow
def test_nothing_is_checked_outside_of_tests() -> None:
    script = """
        import importlib, pkgutil, sys
        import jax.numpy as jnp
        import dipn_jax
        for info in pkgutil.walk_packages(dipn_jax.__path__, "dipn_jax."):
            importlib.import_module(info.name)
        assert "beartype" not in sys.modules
        from dipn_jax import geometry, structs
        assert geometry.wrap_angle(jnp.zeros(3, int)).shape == (3,)
        assert structs.Outcome(0, jnp.zeros((2, 5))).held == 0
        """
    subprocess.run([sys.executable, "-c", textwrap.dedent(script)], check=True)


def test_faults_are_bits_of_int32() -> None:
    codes = jnp.array([0, 1, 24], jnp.int32)
    for found in (codes | jnp.where(codes > 0, Fault.TIPPED, 0), codes & Fault.UNUSABLE, codes & ~Fault.SPEED):
        assert found.dtype == jnp.int32
    np.testing.assert_array_equal(Fault.usable(codes), [True, False, False])
    assert Fault.count(codes) == {name: int(bit in (1, 8, 16)) for bit, name in Fault.NAMES.items()}
    assert [int(fault) for fault in Fault] == list(Fault.NAMES)
