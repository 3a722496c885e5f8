"""Train DIPN for a few steps on a few pushes, and use what it has learnt."""

import json
import pathlib
import tempfile

import jax
from dipn_jax.datagen import cli as datagen
from dipn_jax.train import cli as train
from dipn_jax.train.configs import TrainConfig

import dipn_jax
from dipn_jax.planning import predictors

folder = pathlib.Path(tempfile.mkdtemp())
datagen.push(folder / "data", episodes=40, objects="3", actions=4, shard_size=40)
schedule = TrainConfig(steps=30, batch=16, learning_rate=3e-3, eval_every=10, save_every=30)
train.push(folder / "data", folder / "run", config=schedule)

# the run holds its learning curve, and checkpoints that are read like those that come with the package
lines = (folder / "run" / "metrics.jsonl").read_text().splitlines()
curve = [json.loads(line) for line in lines]
for point in curve:
    print(f"step {point['step']}: loss {point['loss']:.2f}, held out {point['held_out_loss']:.2f}")

episode = dipn_jax.read_episodes(folder / "data")[0]
observation = dipn_jax.render(episode.scene, episode.poses[0])
predict = jax.jit(predictors.load_predictor(folder / "run"))
motion = predict(observation, episode.push[None])
print("predicted motion (m, m, rad) of each object:", motion[0].round(3))
