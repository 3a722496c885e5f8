"""Traced programs kept on disk."""

import pathlib
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax.physics import program_cache


@pytest.fixture
def cache(tmp_path: pathlib.Path) -> Iterator[pathlib.Path]:
    before = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path / "traced"
    jax.config.update("jax_compilation_cache_dir", before)


def test_a_program_is_traced_once_unless_anything_differs_or_its_file_is_damaged(cache: pathlib.Path) -> None:
    traced = []

    def made(what: str = "a", rows: int = 3) -> Callable[..., object]:
        def function(x: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
            traced.append(what)
            return jnp.linalg.cholesky(x @ x.T + jnp.eye(rows)), y + 1

        call = program_cache.program(function, [np.ones((rows, 2), np.float32), np.zeros(4)], what=what, donate=[1])
        found, more = call(np.ones((rows, 2), np.float32), np.zeros(4, np.float32))
        wanted = np.linalg.cholesky(np.full((rows, rows), 2) + np.eye(rows))
        np.testing.assert_allclose(found, wanted, atol=1e-5)
        np.testing.assert_array_equal(more, np.ones(4))
        return call

    made()
    made()
    assert traced == ["a"] and len(list(cache.iterdir())) == 1
    made("b")
    made(rows=5)
    assert traced == ["a", "b", "a"] and len(list(cache.iterdir())) == 3
    for path in cache.iterdir():
        path.write_bytes(path.read_bytes()[:100])
    made()
    made()
    assert traced == ["a", "b", "a", "a"]


def test_a_folder_that_cannot_be_written_keeps_nothing_and_breaks_nothing(cache: pathlib.Path) -> None:
    cache.write_text("a file in the folder's place")
    (found,) = program_cache.program(lambda x: (x + 1,), [np.zeros(2)], what="", donate=())(np.zeros(2))
    assert found.tolist() == [1, 1]


def test_without_a_cache_nothing_is_kept(cache: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(cache.parent)
    jax.config.update("jax_compilation_cache_dir", None)
    (found,) = program_cache.program(lambda x: (x + 1,), [np.zeros(2)], what="", donate=())(np.zeros(2))
    assert found.tolist() == [1, 1] and not list(cache.parent.iterdir())
