"""The program `dipn-datagen`: push, grasp, images, replay, export, merge, check-world, verify, repair, info."""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from dipn_jax.commands import command_line, console
from dipn_jax.commands.launch import LOCAL, Launch
from dipn_jax.errors import UserError
from dipn_jax.names import EngineName
from dipn_jax.system.addresses import Place
from dipn_jax.world.ranges import DEFAULT_RANGES, Objects, Ranges

from . import upkeep
from .check_command import check_world
from .export_command import export
from .merge_command import merge
from .replay_command import replay

if TYPE_CHECKING:
    from dipn_jax.planning.planner import Scorer

    from .generate import Job


@dataclasses.dataclass(frozen=True)
class Work:
    """The engine that makes a data set, and the part of it that this worker makes."""

    engine: EngineName = "auto"
    """native (CPU), mjx (XLA), mjx_warp (its time steps by a kernel of NVIDIA Warp), warp (MuJoCo Warp), or auto."""
    timestep: float | None = None
    """Seconds of a physics step; the engine's own if not given."""
    shard: int = 0
    """This worker's number."""
    of: int = 1
    """Number of workers; each makes every of-th shard of the same data set."""
    threads: int | None = None
    """Threads of the native engine, one per core by default; if given, shards are made one at a time."""

    launch: Launch = LOCAL
    """Where the shards are made."""

    def __post_init__(self) -> None:
        if self.launch.uses_cluster and self.of > 1:
            raise UserError("--launcher ray makes all shards: leave out --shard and --of")


DEFAULT_WORK = Work()
"""One worker that makes everything, with the engine that is faster here."""


def _generate(job: Job, out: pathlib.Path, work: Work, given: dict[str, Any], *, scorer: Scorer | None = None) -> None:
    """Generate what `job` says; `given` are the options that the command was called with, to be kept."""
    from .generate import generate

    work.launch.begin()
    command = command_line.words(COMMANDS[job.kind], given, without=command_line.WORKER_OPTIONS)
    elsewhere = None
    if work.launch.uses_cluster:
        from . import shard_tasks

        elsewhere = shard_tasks.elsewhere(work.launch, threads=work.threads, network=given.get("grasp_net"))
    generate(
        job,
        out,
        part=work.shard,
        of=work.of,
        threads=work.launch.threads(work.threads),
        scorer=scorer,
        command=(job.kind, *command),
        elsewhere=elsewhere,
    )


def push(
    out: Place,
    episodes: int = 1500,
    objects: Objects = "paper",
    seed: int = 0,
    actions: int = 3,
    distances: tuple[float, ...] = (0.10,),
    shard_size: int = 500,
    ranges: Ranges = DEFAULT_RANGES,
    work: Work = DEFAULT_WORK,
) -> None:
    """Make push episodes: a settled scene, one 10 cm push, poses at every centimetre.

    1,500 episodes take about a minute on two cores:
      dipn-datagen push --out data/push --episodes 1500

    The same pushes at three distances, each ended by its own retreat:
      dipn-datagen push --out data/sweep --distances 0.03 0.06 0.1 --shard-size 300

    As tasks of a Ray cluster, each a shard:
      dipn-datagen push --out data/million --episodes 1000000 --launcher ray --num-cpus 4

    Args:
      out: folder of the data set, or a URL (s3, gs, az, file); the same command continues, more --episodes extend it.
      episodes: number of episodes.
      objects: number of objects in a scene.
      seed: random seed of everything.
      actions: different pushes tried on each settled scene.
      distances: metres, up to 0.1; every push is made once for each of them, from the same settled scene.
      shard_size: episodes in a file; files are the unit of resuming and of sharing work.
      ranges: the ranges that random objects are drawn from.
      work: engine and share of the work.
    """
    given = dict(locals())
    from dipn_jax.world import scenes

    from .generate import Job

    job = Job(
        kind="push",
        scene=scenes.parse_objects(objects, ranges=ranges),
        episodes=episodes,
        seed=seed,
        shard_size=shard_size,
        actions=actions,
        distances=distances,
        engine=work.engine,
        timestep=work.timestep,
    )
    _generate(job, out, work, given)


def grasp(
    out: Place,
    episodes: int = 3000,
    objects: Objects = "10",
    seed: int = 0,
    actions: int = 6,
    shard_size: int = 600,
    grasp_net: pathlib.Path | None = None,
    guided: float | None = None,
    unsure: float | None = None,
    ranges: Ranges = DEFAULT_RANGES,
    work: Work = DEFAULT_WORK,
) -> None:
    """Make grasp episodes: a settled scene, one grasp, held or not.

    At random foreground pixels and angles; 3,000 episodes take a little over a minute on two cores:
      dipn-datagen grasp --out data/grasp --episodes 3000

    Half where a network would grasp, a quarter where it is unsure, the others random:
      dipn-datagen grasp --grasp-net runs/gn-pretrained --out data/guided --episodes 12000

    Args:
      out: folder of the data set, or a URL (s3, gs, az, file); the same command continues, more --episodes extend it.
      episodes: number of episodes.
      objects: number of objects in a scene.
      seed: random seed of everything.
      actions: different grasps tried on each settled scene.
      shard_size: episodes in a file.
      grasp_net: run of dipn-train, or builtin; none: all grasps are random.
      guided: share of grasps that the network scores high, 0 to 1; 0.5 unless given.
      unsure: share of grasps that the network is unsure of, 0 to 1; 0.25 unless given.
      ranges: the ranges that random objects are drawn from.
      work: engine and share of the work.
    """
    if grasp_net is None and (guided is not None or unsure is not None):
        raise UserError("--guided and --unsure are shares of grasps that a network chooses: give --grasp-net, too")
    given = dict(locals())
    from dipn_jax.world import scenes

    from .generate import Job

    job = Job(
        kind="grasp",
        scene=scenes.parse_objects(objects, ranges=ranges),
        episodes=episodes,
        seed=seed,
        shard_size=shard_size,
        actions=actions,
        engine=work.engine,
        timestep=work.timestep,
    )
    if grasp_net is None:
        _generate(job, out, work, given)
    else:
        guided, unsure = 0.5 if guided is None else guided, 0.25 if unsure is None else unsure
        _generate_guided(job, out, work, given, guided=guided, unsure=unsure)


def _generate_guided(
    job: Job, out: pathlib.Path, work: Work, given: dict[str, Any], *, guided: float, unsure: float
) -> None:
    """Generate grasps, the shares `guided` and `unsure` of which a network chooses."""
    from dipn_jax.planning import scorers
    from dipn_jax.storage import checkpoint

    if not (guided >= 0 and unsure >= 0 and 0 < guided + unsure <= 1):
        raise UserError(f"--guided {guided:g} --unsure {unsure:g}: want two shares whose sum is over 0 and at most 1")
    work.launch.begin()
    network: Any = checkpoint.load_network(given["grasp_net"], network="grasp")
    job = dataclasses.replace(job, guided=guided, unsure=unsure, weights=checkpoint.digest(network))
    _generate(job, out, work, given, scorer=scorers.aided_scorer(network))


def images(
    out: Place,
    episodes: int = 100,
    objects: Objects = "10",
    seed: int = 0,
    shard_size: int = 100,
    ranges: Ranges = DEFAULT_RANGES,
    work: Work = DEFAULT_WORK,
) -> None:
    """Make settled scenes without an action, for GN's pre-training on images.

      dipn-datagen images --out data/images --episodes 100

    Args:
      out: folder of the data set, or a URL (s3, gs, az, file); the same command continues, more --episodes extend it.
      episodes: number of scenes.
      objects: number of objects in a scene.
      seed: random seed of everything.
      shard_size: scenes in a file.
      ranges: the ranges that random objects are drawn from.
      work: engine and share of the work.
    """
    given = dict(locals())
    from dipn_jax.world import scenes

    from .generate import Job

    job = Job(
        kind="images",
        scene=scenes.parse_objects(objects, ranges=ranges),
        episodes=episodes,
        seed=seed,
        shard_size=shard_size,
        actions=1,
        engine=work.engine,
        timestep=work.timestep,
    )
    _generate(job, out, work, given)


COMMANDS: dict[str, Callable[..., Any]] = {
    "push": push,
    "grasp": grasp,
    "images": images,
    "replay": replay,
    "export": export,
    "merge": merge,
    "check-world": check_world,
    "verify": upkeep.verify,
    "repair": upkeep.repair,
    "info": upkeep.info,
}
"""The commands of `dipn-datagen`, by name."""


def main() -> None:
    """Run `dipn-datagen` and exit with its exit code."""
    sys.exit(console.run("Generate push and grasp episodes with rigid-body physics.", COMMANDS))


if __name__ == "__main__":
    main()
