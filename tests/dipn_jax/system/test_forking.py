"""Worker processes: forked ones read, whatever their parent did; they do not hang where they would need JAX."""

import os
import pathlib
import subprocess
import sys

import jax
import pytest

from dipn_jax.errors import UserError
from dipn_jax.system import forking

SCRIPT = """
import multiprocessing, sys
import jax, numpy as np
from jax._src import xla_bridge
import dipn_jax
from dipn_jax.world import clutter, primitives, scenes

FOLDER = sys.argv[1]

def read(i):
    return dipn_jax.read_episodes(FOLDER).poses[i].sum()

def render(i):
    episode = dipn_jax.read_episodes(FOLDER)[i]
    return np.asarray(dipn_jax.render(episode.scene, episode.poses[0]).height).sum()

def push(i):
    some = dipn_jax.read_episodes(FOLDER)[i : i + 1]
    primitives.push(dipn_jax.make_engine("native", threads=1), some.scene, some.poses[:, 0], some.push)

def drop(i):
    clutter.settled(np.zeros(2, np.uint32), None, scenes.SceneConfig(), 1)

def load(i):
    dipn_jax.load_network(network="grasp")

def act(i):
    POLICY(np.zeros(2, np.uint32), OBSERVATION)

def said(task):
    try:
        return f"no error but {task[0](task[1])}"
    except dipn_jax.UserError as error:
        return str(error)

if __name__ == "__main__":
    fork, spawn = map(multiprocessing.get_context, ("fork", "spawn"))
    wanted = [read(i) for i in range(3)]
    assert not xla_bridge._backends, "reading has started JAX"
    with fork.Pool(1) as pool:
        early = pool.apply(render, [1])
    here = render(1)
    assert xla_bridge._backends and early == here
    POLICY, OBSERVATION = dipn_jax.load_policy("gn"), None  # what the parent has loaded
    with fork.Pool(2) as pool:
        assert pool.map(read, range(3)) == wanted
        for name in (render, push, drop, load, act):
            found = pool.map_async(said, [(name, 0)]).get(60)
            assert "was forked after JAX had been used" in found[0] and "spawn" in found[0], (name, found)
    with spawn.Pool(1) as pool:
        assert pool.apply(render, [1]) == here
    print("as wanted")
"""


LOADER = """
import sys
import jax.numpy as jnp, torch
from torch.utils.data import DataLoader, Dataset
import dipn_jax

class Pushes(Dataset):
    def __len__(self):
        return 8

    def __getitem__(self, i):
        return torch.from_numpy(dipn_jax.read_episodes(sys.argv[1]).poses[i].copy())

if __name__ == "__main__":
    wanted = torch.from_numpy(dipn_jax.read_episodes(sys.argv[1]).poses[:8].copy())
    jnp.zeros(1).block_until_ready()  # JAX has computed before workers are forked
    loader = DataLoader(Pushes(), batch_size=4, num_workers=2, multiprocessing_context="fork", timeout=120)
    assert torch.equal(torch.cat(list(loader)), wanted)
    print("as wanted")
"""
"""Episodes as examples of PyTorch, read by two forked workers."""


def _run(script: str, data: pathlib.Path, tmp_path: pathlib.Path) -> None:
    """Run a script on a data set in a process of its own, which has to say that all is as wanted."""
    (tmp_path / "work.py").write_text(script)
    kept = {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir)}
    done = subprocess.run(
        [sys.executable, str(tmp_path / "work.py"), str(data)],
        capture_output=True,
        text=True,
        timeout=400,
        env=os.environ | kept,
        check=False,
    )
    assert done.stdout == "as wanted\n", done.stderr[-3000:]


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_forked_workers_read_and_spawned_ones_render(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> None:
    _run(SCRIPT, data["push"], tmp_path)


def test_workers_of_pytorch_read(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> None:
    pytest.importorskip("torch")
    _run(LOADER, data["push"], tmp_path)


def test_a_guarded_function_checks_before_every_call(monkeypatch: pytest.MonkeyPatch) -> None:
    double = forking.guarded(jax.jit(lambda x: 2 * x))
    assert double(2) == 4
    monkeypatch.setattr(forking, "_forked_after_jax", True)
    with pytest.raises(UserError, match="forked after JAX had been used"):
        double(2)
