"""Checkpoints: Orbax arrays, the config that rebuilds the network, and checksums. No other module reads or writes them.

`RUN/checkpoints/STEP/` holds an Orbax folder for each part (`model`, `train`) and `meta.json`. Orbax restores
flipped bits silently and takes an empty step folder for the latest, so every file's SHA-256 is kept, and
reading goes back to the newest step that is whole.
"""

from __future__ import annotations

import dataclasses
import errno
import functools
import hashlib
import os
import pathlib
import shutil
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from flax import nnx

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.networks import dipn, grasp, vpg
from dipn_jax.storage import leaves, owner, quiet, stored_step
from dipn_jax.system import files, forking, temporary, typed

ACCEPTED_RUNS_TEXT = (
    "give a run (the --out of dipn-train), one step of it (RUN@STEP, RUN@best) or that step's folder "
    "(RUN/checkpoints/STEP)"
)
"""What is accepted where a network is asked for, for messages."""
SHIPPED = pathlib.Path(__file__).parents[1] / "data"
"""Folder of the runs that come with the package, one a network."""
FORMAT_VERSION = 1
"""Version of the format; steps of another version are ignored."""
NETWORKS: dict[str, tuple[type, type]] = {
    "dipn": (dipn.DipnConfig, dipn.DIPN),
    "grasp": (grasp.GraspConfig, grasp.GraspNet),
    "vpg": (vpg.VpgConfig, vpg.VPG),
}
"""Config and class of each network by its name."""


def build(name: str, config: Any, *, seed: int = 0) -> nnx.Module:
    """Return a freshly initialized network of the given name and config."""
    return NETWORKS[name][1](config, rngs=nnx.Rngs(seed))


def _steps(run: pathlib.Path) -> list[pathlib.Path]:
    """Return the step folders of a run, newest first; of a step's folder, itself."""
    if run.name.isdecimal() and run.resolve().parent.name == "checkpoints":
        return [run] if run.is_dir() else []
    folder = run / "checkpoints"
    found = [p for p in folder.iterdir() if p.name.isdecimal()] if folder.is_dir() else []
    return sorted(found, key=lambda p: int(p.name), reverse=True)


def _flat(tree: Any) -> dict[str, Any]:
    """Return the leaves of a pytree by their path."""
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def save(
    run: pathlib.Path, step: int, parts: dict[str, Any], *, network: str, config: Any, extra: Any, keep: int = 2
) -> None:
    """Write one step, atomically, and drop all but the newest `keep` and the best.

    Args:
      run: the run's folder.
      step: training step.
      parts: pytrees of arrays, one Orbax folder each; `model` is what `load_network` reads.
      network: a key of NETWORKS.
      config: the network's config dataclass.
      extra: seed, data fingerprint, training config, and `best` as `stored_step.FORM` has it, if there is a best step;
        it has to fit into JSON.
      keep: number of steps that are kept.
    """
    final = run.resolve() / "checkpoints" / f"{step:08d}"
    begun = temporary.temporary_path(final)
    about = {"network": network, "network_config": dataclasses.asdict(config), "step": step}
    try:
        _write(begun, parts, about, extra)
        shutil.rmtree(final, ignore_errors=True)
        files.move(begun, final)
    finally:
        files.remove_folder(begun)
    older = [folder for folder in _steps(run) if int(folder.name) < step and _whole(folder) is not None]
    for old in older[keep - 1 :]:
        if int(old.name) != extra.get("best", {}).get("step"):
            shutil.rmtree(old)


def _write(folder: pathlib.Path, parts: dict[str, Any], about: dict[str, Any], extra: Any) -> None:
    """Write the arrays and the metadata of one step into `folder`.

    Raises:
      UserError: there is no space for it.
    """
    folder.mkdir(parents=True)
    checkpointer = ocp.StandardCheckpointer(multiprocessing_options=stored_step.single_process_options())
    try:
        with quiet.failed_saves():  # what Orbax prints is said in one line below
            for name, tree in parts.items():
                checkpointer.save(folder / name, _flat(tree))
            checkpointer.wait_until_finished()
    except Exception as error:  # TensorStore has errors of its own for what the system says
        reason = _system_error(error)
        if reason is None:
            raise
        raise UserError(
            f"{folder.parents[1]}: step {about['step']} cannot be saved ({reason}); earlier steps are whole; make "
            "space and give the same command to continue"
        ) from None
    for marker in folder.rglob("commit_success.txt"):  # Orbax writes the present folder into it
        marker.write_bytes(b"Checkpoint commit was successful\n")
    stored = sorted(p for p in folder.rglob("*") if p.is_file())
    meta = {
        "format_version": FORMAT_VERSION,
        **about,
        "versions": files.package_versions(),
        "sha256": {str(p.relative_to(folder)): files.file_sha256(p) for p in stored},
        **extra,
    }
    files.write_json(folder / "meta.json", meta)


def _system_error(error: Exception) -> str | None:
    """Return what the system said, where an error says that the disk is full or cannot be written; None if not."""
    said = f"{error} {error.__cause__ or ''}"
    numbers = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EFBIG)
    return next((os.strerror(n) for n in numbers if getattr(error, "errno", None) == n or os.strerror(n) in said), None)


def export(run: pathlib.Path, out: pathlib.Path, *, network: str) -> None:
    """Copy the weights of the newest whole step of a run to `out`, without what only training needs.

    What was exported there before is replaced.

    Raises:
      UserError: as `load_network`; or `out` holds a training, or somebody else has it.
    """
    model = load_network(run, network=network)
    folder, meta = newest(find(run, network=network))  # type: ignore[misc]
    known = ("format_version", "network", "network_config", "step", "versions", "sha256", "best")
    extra = {key: value for key, value in meta.items() if key not in known}
    config = stored_step.config(NETWORKS[network][0], meta["network_config"])
    with owner.owned(out):
        if (out / "config.json").exists() or any((step / "train").exists() for step in _steps(out)):
            raise UserError(f"--out {out}: holds a training; give another folder")
        parts = {"model": nnx.state(model)}
        save(out, int(folder.name), parts, network=network, config=config, extra=extra, keep=1)


def _whole(folder: pathlib.Path) -> dict[str, Any] | None:
    """Return the metadata of a step folder, or None if anything in it is missing or changed.

    What this user may not read is not taken for damage: the step before it would be used.
    """
    try:
        meta: dict[str, Any] = typed.check(typed.parse(files.read_bytes(folder / "meta.json")), stored_step.FORM)
        stored = {typed.inside(folder, name): digest for name, digest in meta["sha256"].items()}
        good = all(files.file_sha256(path) == digest for path, digest in stored.items())
    except PermissionError:
        raise
    except (OSError, typed.Misfit):
        return None
    return meta if good and meta["format_version"] == FORMAT_VERSION and meta["network"] in NETWORKS else None


def newest(run: pathlib.Path) -> tuple[pathlib.Path, dict[str, Any]] | None:
    """Return the newest whole step of a run and its metadata, None if there is none; warn of a damaged newer one."""
    steps = _steps(run)
    for number, folder in enumerate(steps):
        meta = _whole(folder)
        if meta is not None:
            if number:
                damaged = ", ".join(str(one) for one in steps[:number])
                _warn_once(f"{damaged}: damaged; step {meta['step']} of {run} is used instead")
            return folder, meta
    return None


@functools.cache
def _warn_once(text: str) -> None:
    """Warn, once a process: a command looks for the newest step several times."""
    console.warn(text)


def used(run: pathlib.Path) -> dict[str, Any] | None:
    """Return number and digest of the step that a run loads: the SHA-256 of its metadata, which list those of files."""
    found = newest(run)
    return found and {"step": found[1]["step"], "digest": files.file_sha256(found[0] / "meta.json")}


def restore(folder: pathlib.Path, name: str, target: Any) -> Any:
    """Restore one part of a step, in the structure of `target`, on this process's default device.

    Orbax would put arrays back on the devices that saved them, which another machine does not have; so they are read
    as NumPy arrays.

    Raises:
      UserError: the stored arrays have other names or shapes.
    """
    stored = stored_step.arrays((folder / name).resolve())
    wanted = _flat(target)
    different = sorted(set(stored) ^ set(wanted)) + [
        key for key in wanted if key in stored and stored[key].shape != leaves.stored_shape(wanted[key])
    ]
    if different:
        raise UserError(
            f"checkpoint {folder}: made for another architecture ({len(different)} arrays differ, first "
            f"{different[0]}); train again, or give the run it belongs to"
        )
    found = [leaves.on_device(stored[key], like=leaf) for key, leaf in wanted.items()]
    return jax.tree.unflatten(jax.tree.structure(target), found)


def digest(model: nnx.Module) -> str:
    """Return the SHA-256 of a network's parameters."""
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)):
        found.update(np.asarray(leaf).tobytes())
    return found.hexdigest()


def find(run: pathlib.Path, *, network: str) -> pathlib.Path:
    """Return the folder of a run, or of one step of it where `RUN@STEP` or `RUN@best` is given.

    `builtin` stands for the network that comes with the package, if one does.

    Raises:
      UserError: there is no such step, or no such network in the package.
    """
    base, _, step = str(run).rpartition("@")
    if base and (step == "best" or step.isdecimal()) and not run.exists():
        return _step(find(pathlib.Path(base), network=network), step)
    if str(run) != "builtin":
        found = files.absolute(run)
        files.require_locale(found)
        return found
    folder = SHIPPED / network
    if not folder.is_dir():
        raise UserError(f"builtin: no {network} network comes with this package; give the --out of a dipn-train run")
    return folder


def _step(run: pathlib.Path, step: str) -> pathlib.Path:
    """Return the folder of a run's step by its number, or of the best step, which the newest whole one names."""
    steps = {int(folder.name): folder for folder in _steps(run)}
    kept = f"it has {', '.join(map(str, steps))}" if steps else "it has none"
    if step == "best":
        found = newest(run)
        if found is None or "best" not in found[1]:
            raise UserError(f"checkpoint {run}@best: this run knows no best step; give RUN or RUN@STEP ({kept})")
        step = str(found[1]["best"]["step"])
    if int(step) not in steps:
        raise UserError(f"checkpoint {run}@{step}: no such step of {run}; {kept}")
    return steps[int(step)]


def load_network(run: pathlib.Path | str = "builtin", *, network: str) -> nnx.Module:
    """Load the network of the newest whole step of a run, in evaluation mode.

    Example:
      dipn = dipn_jax.load_network(network="dipn")             # comes with the package
      mine = dipn_jax.load_network("runs/gn", network="grasp")

    Args:
      run: a run's folder, or `builtin`.
      network: a key of NETWORKS, which the run has to hold.

    Raises:
      UserError: no run there, no whole step in it, or it holds another network.
    """
    forking.check()
    run = find(files.not_empty(run), network=network)
    if not run.is_dir():
        what = "a file, not a run's folder" if run.exists() else "no such folder"
        raise UserError(f"checkpoint {run}: {what}; {ACCEPTED_RUNS_TEXT}")
    found = newest(run)
    if found is None:
        raise UserError(f"checkpoint {run}: no whole step under checkpoints/; {ACCEPTED_RUNS_TEXT}, or train again")
    folder, meta = found
    if meta["network"] != network:
        raise UserError(f"checkpoint {run}: holds a {meta['network']} network, want {network}; give another run")
    try:
        config = stored_step.config(NETWORKS[network][0], meta["network_config"])
    except TypeError as error:
        raise UserError(f"checkpoint {run}: its config does not fit this version ({error}); train again") from None
    stored_step.require_room((folder / "model").resolve(), config)
    model = build(network, config)
    nnx.update(model, restore(folder, "model", nnx.state(model)))
    model.eval()
    return model
