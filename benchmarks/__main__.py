"""`python -m benchmarks NAME ...`: one line `name value` a figure, and a JSON file of all with `--out`."""

from __future__ import annotations

import argparse
import pathlib
import sys
from collections.abc import Sequence

from benchmarks.harness import Benchmark, Figures, Setting, Skipped, machine
from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.system import files

BENCHMARKS = {
    "datagen_native.share_of_bare": Benchmark(
        "push episodes on disk a second over what bare MuJoCo steps allow", ">= 0.90", "datagen_native:share_of_bare"
    ),
    "datagen_native.grasp_share_of_bare": Benchmark(
        "grasp episodes on disk a second over what bare MuJoCo steps allow",
        ">= 0.90",
        "datagen_native:grasp_share_of_bare",
    ),
    "drops.cheaper": Benchmark(
        "seconds of drops with every step accurate over those of the engine's; p-values that objects rest alike",
        ">= 1.5",
        "drops:cheaper",
    ),
    "datagen_native.vs_pybullet": Benchmark(
        "drop-and-push episodes a second over PyBullet's", ">= 3", "bullet:vs_pybullet"
    ),
    "datagen_mjx.vs_naive": Benchmark(
        "steps a second of the MJX engine over a loop of jitted mjx.step", ">= 2", "datagen_mjx:vs_naive"
    ),
    "datagen_mjx.batch_scaling": Benchmark(
        "cost of a scene's step at batch 128 over that at batch 16", "<= 1.0", "datagen_mjx:batch_scaling"
    ),
    "datagen_mjx.kernel": Benchmark(
        "seconds of MJX, and of MuJoCo C on a core, over those of MJX's Warp kernel; and of a scene's step",
        "none",
        "datagen_mjx:kernel",
    ),
    "datagen_mjx.settings": Benchmark(
        "other settings of MJX: time over that of its own, millimetres from MuJoCo C after 5 cm, faults",
        "none",
        "mjx_settings:settings",
    ),
    "datagen.encoding": Benchmark(
        "push episodes a second that are encoded and written, physics not counted", ">= 5000", "encoding:encoding"
    ),
    "render.vs_raycast": Benchmark("images a second over MuJoCo's ray caster", ">= 20", "rendering:vs_raycast"),
    "storage.vs_images": Benchmark("bytes of a push over PNGs of its frames", "<= 0.01", "storage:vs_images"),
    "compile.warm_over_cold": Benchmark(
        "first calls with a warm compilation cache over a cold one", "<= 0.3", "compilation:warm_over_cold"
    ),
    "cli.help_vs_jax": Benchmark(
        "seconds of the slowest --help over those of import jax, and seconds", "<= 0.5", "commands:help_vs_jax"
    ),
    "push_net.vs_torch": Benchmark(
        "training samples a second of both DIPNs over the same in PyTorch, and memory", ">= 1", "push_net:vs_torch"
    ),
    "push_net.input_share": Benchmark(
        "share of a training step of the compact DIPN that its inputs take", "<= 0.2", "push_net:input_share"
    ),
    "train.saving": Benchmark(
        "seconds a step of training with checkpoints over without, in the background and in line",
        "<= 1.03",
        "saving:cost",
    ),
    "train.from_files": Benchmark(
        "examples a second of a training whose examples are in files over those in memory",
        ">= 0.9",
        "example_files:cost",
    ),
    "train.first_step": Benchmark(
        "seconds and megabytes of a training of one step on many pushes, which fit in memory or are kept in files",
        "none",
        "first_step:cost",
    ),
    "push_net.batched": Benchmark("64 candidate pushes in one call over a call for each", "none", "push_net:batched"),
    "bench_grasp.compact_vs_torch_paper": Benchmark(
        "seconds of all scores of an image, compact GN over the published one in PyTorch",
        "<= 0.033",
        "bench_grasp:compact_vs_torch_paper",
    ),
    "bench_grasp.paper_vs_torch_paper": Benchmark(
        "seconds of all scores of an image, published GN over the same in PyTorch",
        "<= 1",
        "bench_grasp:paper_vs_torch_paper",
    ),
    "bench_grasp.vs_torch": Benchmark(
        "training samples a second of both GNs over the same in PyTorch, and memory", ">= 1", "bench_grasp:vs_torch"
    ),
    "decide.speed": Benchmark(
        "seconds a decision; with 64 candidates over the published networks one candidate and rotation at a time",
        ">= 50",
        "deciding:speed",
    ),
    "decide.fast_path": Benchmark(
        "share of scenes on which the fast path decides as the plain one", ">= 0.99", "deciding:fast_path"
    ),
    "decide.lockstep": Benchmark("episodes a minute in lockstep over one by one", "none", "deciding:in_lockstep"),
    "engines.scene_seconds": Benchmark(
        "seconds of heaps of seven objects simulated a second, by each engine", "none", "rates:scene_seconds"
    ),
    "jobs.overhead": Benchmark(
        "milliseconds, memory and bytes a shard of a data set of many, without physics", "none", "jobs:overhead"
    ),
    "engines.warp_room": Benchmark(
        "contacts, touching pairs and rows of MuJoCo Warp: the most of a scene, an object", "none", "warp_room:seen"
    ),
    "engines.warp_settings": Benchmark(
        "other settings of MuJoCo Warp: time over that of its own, millimetres from MuJoCo C after 5 cm, iterations",
        "none",
        "warp_settings:settings",
    ),
    "rates.native": Benchmark("episodes a second of MuJoCo C, 1 to 30 objects", "none", "rates:native"),
    "rates.mjx": Benchmark("episodes a second of MJX, 1 to 30 objects", "none", "rates:mjx"),
    "rates.warp": Benchmark("episodes a second of MuJoCo Warp, 1 to 30 objects", "none", "rates:warp"),
}
"""All benchmarks, in the order in which they run."""


def chosen(names: Sequence[str]) -> list[str]:
    """Return the benchmarks that `names` stand for.

    Raises:
      UserError: one of them is none.
    """
    unknown = [name for name in names if name not in (*BENCHMARKS, "all")]
    if unknown:
        raise UserError(f"benchmark {unknown[0]}: no such name; choose from {', '.join(BENCHMARKS)} or all")
    return list(BENCHMARKS) if "all" in names else list(dict.fromkeys(names))


def measure(names: Sequence[str], setting: Setting, out: pathlib.Path | None) -> Figures:
    """Run `chosen(names)`; print each figure and write it to `out` as soon as it is measured.

    Raises:
      UserError: a benchmark that was asked for by name cannot run here.
    """
    figures: Figures = {}
    facts = machine() | {"seed": setting.seed, "scale": setting.scale}
    for name in chosen(names):
        try:
            for figure, value in BENCHMARKS[name].load()(setting):
                figures[figure] = value
                console.say(f"{figure} {value:.4g}")
                if out:
                    files.write_json(out, {"figures": figures, "machine": facts})
        except Skipped as reason:
            if "all" not in names:
                raise UserError(f"{name}: {reason}") from None
            print(f"{name}: skipped: {reason}", file=sys.stderr, flush=True)
    return figures


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks, or all; none: list them")
    parser.add_argument("--out", type=pathlib.Path, metavar="FILE.json", help="write figures and machine as JSON")
    parser.add_argument("--scale", choices=("small", "full"), default="small", help="amount of work (default: small)")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default: 0)")
    options = parser.parse_args(arguments)
    if not options.names:
        for name, benchmark in BENCHMARKS.items():
            console.say(f"{name:36} {benchmark.what} (goal: {benchmark.goal})")
        return 0
    console.enable_compilation_cache()
    try:
        console.require_seed(options.seed)
        if options.out:
            console.require_out(options.out.parent)
        measure(options.names, Setting(options.scale, options.seed), options.out)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
