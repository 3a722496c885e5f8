"""A small data set of pushes: made by the function behind `dipn-datagen push`, and read again."""

import pathlib
import tempfile

import numpy as np
from dipn_jax.datagen import cli as datagen

import dipn_jax

folder = pathlib.Path(tempfile.mkdtemp()) / "pushes"
datagen.push(folder, episodes=8, objects="3", actions=4, shard_size=8)

episodes = dipn_jax.read_episodes(folder)
size = sum(path.stat().st_size for path in folder.glob("*.parquet"))
print(f"{len(episodes.fault)} pushes, {size / len(episodes.fault):.0f} bytes each")

# an episode is state, not pixels: poses [11, N, 7] at 0, 1, ..., 10 cm; images are rendered when they are wanted
episode = episodes[0]
before = dipn_jax.render(episode.scene, episode.poses[0])
after = dipn_jax.render(episode.scene, episode.after)
moved = np.linalg.norm(episode.after[:, :2] - episode.poses[0, :, :2], axis=-1)
print("objects moved by", np.round(100 * moved, 1), "cm;", int((before.label != after.label).sum()), "pixels changed")
