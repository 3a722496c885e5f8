"""`python -m benchmarks.on_gpu --out FILE.json`: what matters on a machine with a GPU, in ten minutes at most.

The stages run one after another, the most important first, in a process beside this one. A stage that fails, dies or
takes too long is one line of the file and of the table, and the others continue. The file is written after every stage;
the same command again measures what is missing in it. `--toy` rehearses everything on a CPU, as small as it can be.
"""

from __future__ import annotations

import argparse
import pathlib
import sys
import time
from collections.abc import Sequence

from benchmarks.gpu_process import Worker
from benchmarks.gpu_record import Record, Stage
from dipn_jax.commands import console
from dipn_jax.errors import UserError

STAGES = {
    "on_gpu.weights": Stage(
        "share of the hard tables on which an action by the shipped networks ended well",
        "gpu_correctness:weights",
        60,
        is_check=True,
        goal=">= 1",
    ),
    "on_gpu.agreement_mjx": Stage(
        "millimetres of MJX from MuJoCo C after 5 cm (p50)",
        "gpu_correctness:agreement_mjx",
        110,
        is_check=True,
        goal="<= 1",
    ),
    "on_gpu.agreement_mjx_warp": Stage(
        "millimetres of MJX with the Warp kernel from MuJoCo C after 5 cm (p50)",
        "gpu_correctness:agreement_mjx_warp",
        60,
        is_check=True,
        goal="<= 1",
    ),
    "on_gpu.agreement_warp": Stage(
        "millimetres of MuJoCo Warp from MuJoCo C after 5 cm (p50)",
        "gpu_correctness:agreement_warp",
        110,
        is_check=True,
        goal="<= 1",
    ),
    "on_gpu.reproducible": Stage(
        "share of a batch that MJX simulates twice to the same bytes, and with the Warp kernel",
        "gpu_correctness:reproducible",
        60,
        is_check=True,
        goal=">= 1",
    ),
    "on_gpu.push_episodes_vs_native": Stage(
        "push episodes on disk a second by the best accelerator over MuJoCo C on all cores",
        "gpu_engines:push_episodes_vs_native",
        260,
        goal=">= 10",
    ),
    "on_gpu.engines": Stage("simulated seconds, drops and pushes a second of each engine", "gpu_engines:engines", 180),
    "on_gpu.variants": Stage("what other settings of the engines give", "gpu_variants:variants", 100),
    "on_gpu.training": Stage(
        "training samples a second, ours over PyTorch on the same card: the least", "gpu_networks:training", 120
    ),
    "on_gpu.decisions": Stage("decisions a second", "gpu_networks:decisions", 40),
    "on_gpu.render": Stage("images a second over MuJoCo's ray caster", "gpu_networks:render", 40, goal=">= 20"),
    "on_gpu.profile": Stage("milliseconds of a control period in kernels of the device", "gpu_profile:profile", 60),
    "on_gpu.encoding": Stage(
        "push episodes a second that are encoded and written", "gpu_engines:encoding", 60, goal=">= 5000"
    ),
}
"""All stages, in order of worth."""
LEAST_SECONDS = 5.0
"""Seconds that have to be left for a stage to begin."""
GRACE_SECONDS = 20.0
"""Seconds beyond its own that a stage may take to its next figure before it is ended."""


def run_stage(worker: Worker, name: str, record: Record, *, toy: bool, seconds: float, end: float) -> str:
    """Measure a stage, taking all it says into the record; return how it ended.

    Args:
      worker: a process that waits for a stage.
      name: of the stage.
      record: the file.
      toy: whether this is a rehearsal.
      seconds: after which it stops at its next figure.
      end: instant of the monotonic clock at which it is ended in any case.

    Raises:
      UserError: there is no accelerator, and this is no rehearsal.
    """
    begun, compiling = time.monotonic(), 0.0
    request = {"stage": name, "place": STAGES[name].place, "seconds": seconds, "toy": toy}
    worker.ask(request | {"seed": record.setting["seed"]})
    state = ""
    try:
        for answer in worker.answers(min(begun + seconds + GRACE_SECONDS, end)):
            if "machine" in answer:
                worker.machine = answer["machine"]
                if not toy and set(worker.machine["devices"]) == {"cpu"}:
                    raise UserError("on_gpu: JAX finds no GPU here; install JAX for CUDA, or rehearse with --toy")
            elif "ended" in answer:
                state, compiling = answer["ended"], answer["compiling"]
            else:
                record.note(answer)
    except TimeoutError:
        state = f"failed: not done after {time.monotonic() - begun:.0f} s"
    except EOFError as error:
        state = f"failed: {error}"
    taken = time.monotonic() - begun
    record.end(name, state, seconds=taken, compiling=compiling, facts=worker.machine)
    console.say(f"{name} {state} ({taken:.1f} s, {compiling:.1f} s of them compiling)")
    return state


def run(out: pathlib.Path, *, minutes: float, toy: bool, seed: int) -> int:
    """Measure what is missing in `out`, print the table, and return the exit code: 1 if something is not correct.

    Raises:
      UserError: the file cannot be written, or is of another scale or seed; or there is no accelerator.
    """
    console.require_positive(minutes=minutes)
    console.require_seed(seed)
    console.require_out(out.parent)
    record, end = Record(out, scale="toy" if toy else "full", seed=seed), time.monotonic() + 60 * minutes
    worker: Worker | None = None
    try:
        for name, stage in STAGES.items():
            if record.is_measured(name):
                continue
            record.forget(name)
            left = end - time.monotonic()
            if left < LEAST_SECONDS:
                continue
            worker = worker or Worker()
            seconds = left if toy else min(stage.seconds * minutes / 10, left)
            if run_stage(worker, name, record, toy=toy, seconds=seconds, end=end).startswith("failed"):
                worker.end()  # a device that has failed once fails for the rest of a process
                worker = None
    finally:
        if worker is not None:
            worker.end()
    console.say(record.table(STAGES))
    states = {name: record.kept["stages"].get(name, {}).get("state", "") for name in STAGES}
    return int(any(STAGES[name].is_check and state.startswith("failed") for name, state in states.items()))


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(prog="python -m benchmarks.on_gpu", description=__doc__)
    made.add_argument("--out", type=pathlib.Path, required=True, metavar="FILE.json", help="figures and machine")
    made.add_argument("--minutes", type=float, default=10.0, help="that all of it may take (default: 10)")
    made.add_argument("--toy", action="store_true", help="rehearse on a CPU, as small as can be")
    made.add_argument("--seed", type=int, default=0, help="of everything random (default: 0)")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    options = parser().parse_args(arguments)
    console.enable_compilation_cache()
    return console.exit_code(lambda: run(options.out, minutes=options.minutes, toy=options.toy, seed=options.seed))


if __name__ == "__main__":
    sys.exit(main())
