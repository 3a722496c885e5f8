import errno
import json
import pathlib
import resource
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dipn_jax.eval import options
from flax import nnx

from dipn_jax.errors import UserError
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.storage import checkpoint, owner, resume, stored_step
from dipn_jax.system import files

CONFIG = GraspConfig(width=8)
BUILTIN = pathlib.Path("builtin")


def _save(run: pathlib.Path, step: int, seed: int = 0) -> nnx.Module:
    model = checkpoint.build("grasp", CONFIG, seed=seed)
    checkpoint.save(run, step, {"model": nnx.state(model)}, network="grasp", config=CONFIG, extra={})
    return model


def _save_with_best(run: pathlib.Path, step: int, best: int) -> None:
    extra = {"best": {"step": best, "measure": "held_out_loss", "value": 0.5}}
    parts = {"model": nnx.state(checkpoint.build("grasp", CONFIG, seed=step))}
    checkpoint.save(run, step, parts, network="grasp", config=CONFIG, extra=extra)


def _leaves(model: nnx.Module) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(nnx.state(model))]


def test_saved_weights_are_loaded_unchanged(tmp_path: pathlib.Path) -> None:
    model = _save(tmp_path, 10, seed=3)
    loaded = checkpoint.load_network(tmp_path, network="grasp")
    assert loaded.config == CONFIG
    for a, b in zip(_leaves(model), _leaves(loaded), strict=True):
        np.testing.assert_array_equal(a, b)


def _moved_to(run: pathlib.Path, device: str) -> None:
    """Rewrite the checkpoints of a run as if `device` had saved them."""
    for sharding in run.rglob("_sharding"):
        here = str(jax.local_devices()[0])
        assert here in sharding.read_text()
        sharding.write_text(sharding.read_text().replace(here, device))
        step = next(folder for folder in sharding.parents if (folder / "meta.json").exists())
        meta = json.loads((step / "meta.json").read_text())
        meta["sha256"][str(sharding.relative_to(step))] = files.file_sha256(sharding)
        (step / "meta.json").write_text(json.dumps(meta))


@pytest.mark.parametrize("device", ["cuda:0", "TPU_0(process=0,(0,0,0,0))", "TFRT_CPU_7"])
def test_weights_load_on_another_device_than_saved_them(tmp_path: pathlib.Path, device: str) -> None:
    model = _save(tmp_path, 10, seed=3)
    _moved_to(tmp_path, device)
    loaded = checkpoint.load_network(tmp_path, network="grasp")
    for a, b in zip(_leaves(model), _leaves(loaded), strict=True):
        np.testing.assert_array_equal(a, b)
    on = {leaf.device for leaf in jax.tree.leaves(nnx.state(loaded))}
    assert on == {jax.devices()[0]}, "arrays of this process's device, not of the host"


def test_random_keys_come_back_as_keys_on_another_device(tmp_path: pathlib.Path) -> None:
    """The published GN keeps its dropout's key beside its weights."""
    state = {"key": jax.random.key(3), "count": jnp.int32(7)}
    parts = {"model": nnx.state(checkpoint.build("grasp", CONFIG)), "train": state}
    checkpoint.save(tmp_path, 1, parts, network="grasp", config=CONFIG, extra={})
    _moved_to(tmp_path, "cuda:0")
    folder, _ = checkpoint.newest(tmp_path)  # type: ignore[misc]
    fresh = {"key": jax.random.key(0), "count": jnp.int32(0)}
    restored = checkpoint.restore(folder, "train", fresh)
    assert restored["key"].dtype == state["key"].dtype and int(restored["count"]) == 7
    assert jax.random.uniform(restored["key"]) == jax.random.uniform(state["key"])


@pytest.mark.parametrize("network", ["dipn", "grasp"])
def test_the_shipped_weights_load_where_no_device_has_the_name_of_the_one_that_saved_them(
    network: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Imitates a GPU host: Orbax looks for the saved device's name among these."""

    class Device:
        def __init__(self, real: jax.Device) -> None:
            self.real = real

        def __getattr__(self, name: str) -> object:
            return getattr(self.real, name)

        def __str__(self) -> str:
            return "cuda:0"

    devices = [Device(device) for device in jax.local_devices()]
    monkeypatch.setattr(jax, "local_devices", lambda *_, **__: devices)
    assert all(np.isfinite(leaf).all() for leaf in _leaves(checkpoint.load_network(BUILTIN, network=network)))


@pytest.mark.parametrize("damage", ["flip", "empty", "no meta"])
def test_a_damaged_step_is_skipped(tmp_path: pathlib.Path, damage: str) -> None:
    good = _save(tmp_path, 1, seed=1)
    _save(tmp_path, 2, seed=2)
    step = tmp_path / "checkpoints" / "00000002"
    if damage == "flip":
        largest = max((p for p in step.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
        content = bytearray(largest.read_bytes())
        content[len(content) // 2] ^= 1
        largest.write_bytes(content)
    elif damage == "empty":
        (tmp_path / "checkpoints" / "00000003").mkdir()
        (step / "meta.json").write_text("{}")
    else:
        (step / "meta.json").unlink()
    loaded = checkpoint.load_network(tmp_path, network="grasp")
    np.testing.assert_array_equal(_leaves(loaded)[0], _leaves(good)[0])


def test_the_best_step_is_kept_and_found(tmp_path: pathlib.Path) -> None:
    for step, best in ((1, 1), (2, 2), (3, 2), (4, 2), (5, 2)):
        _save_with_best(tmp_path, step, best)
    assert sorted(int(p.name) for p in (tmp_path / "checkpoints").iterdir()) == [2, 4, 5]
    best = checkpoint.load_network(f"{tmp_path}@best", network="grasp")
    wanted = checkpoint.build("grasp", CONFIG, seed=2)
    np.testing.assert_array_equal(_leaves(best)[0], _leaves(wanted)[0])
    found = checkpoint.find(pathlib.Path(f"{tmp_path}@best"), network="grasp")
    assert checkpoint.used(found)["step"] == 2  # type: ignore[index]
    _save_with_best(tmp_path, 6, 6)
    assert sorted(int(p.name) for p in (tmp_path / "checkpoints").iterdir()) == [5, 6]


def test_a_best_step_that_is_unknown_or_gone_is_one_line(tmp_path: pathlib.Path) -> None:
    _save(tmp_path / "acted", 3)
    with pytest.raises(UserError, match=r"acted@best: this run knows no best step; give RUN or RUN@STEP \(it has 3\)"):
        checkpoint.load_network(f"{tmp_path / 'acted'}@best", network="grasp")
    with pytest.raises(UserError, match=r"none@best: this run knows no best step; .*it has none"):
        checkpoint.load_network(f"{tmp_path / 'none'}@best", network="grasp")
    with pytest.raises(UserError, match=r"@7: no such step of .*data/grasp; it has \d+$"):
        checkpoint.load_network("builtin@7", network="grasp")
    _save_with_best(tmp_path / "lost", 3, 2)
    with pytest.raises(UserError, match=r"lost@2: no such step of .*lost; it has 3$"):
        checkpoint.load_network(f"{tmp_path / 'lost'}@best", network="grasp")


def test_only_the_newest_steps_are_kept(tmp_path: pathlib.Path) -> None:
    for step in (1, 2, 3):
        _save(tmp_path, step)
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["00000002", "00000003"]
    (tmp_path / "checkpoints" / "00000003" / "meta.json").write_text("[]")
    _save(tmp_path, 4)
    assert checkpoint.newest(tmp_path)[1]["step"] == 4  # type: ignore[index]
    assert (tmp_path / "checkpoints" / "00000002").exists(), "the damaged step does not push out the good one"


def test_a_run_that_cannot_be_used_is_named(tmp_path: pathlib.Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        checkpoint.load_network(tmp_path / "nowhere", network="grasp")
    (tmp_path / "sweep.json").touch()
    with pytest.raises(UserError, match=r"sweep\.json: a file, not a run's folder; give a run"):
        checkpoint.load_network(tmp_path / "sweep.json", network="grasp")
    with pytest.raises(UserError, match="no whole step"):
        checkpoint.load_network(tmp_path, network="grasp")
    _save(tmp_path, 1)
    with pytest.raises(UserError, match="holds a grasp network, want dipn"):
        checkpoint.load_network(tmp_path, network="dipn")


def test_another_architecture_is_named(tmp_path: pathlib.Path) -> None:
    _save(tmp_path, 1)
    path = tmp_path / "checkpoints" / "00000001" / "meta.json"
    meta = json.loads(path.read_text())
    meta["network_config"]["width"] = 16
    path.write_text(json.dumps(meta))
    with pytest.raises(UserError, match="another architecture"):
        checkpoint.load_network(tmp_path, network="grasp")
    meta["network_config"]["depth"] = 3
    path.write_text(json.dumps(meta))
    with pytest.raises(UserError, match="config does not fit"):
        checkpoint.load_network(tmp_path, network="grasp")


def test_a_damaged_newest_step_is_named_once_with_the_step_used(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _save(tmp_path, 1)
    _save(tmp_path, 2, seed=1)
    newest = tmp_path / "checkpoints" / "00000002"
    (newest / "meta.json").write_text("{}")
    checkpoint.load_network(tmp_path, network="grasp")
    partial = resume.Partial(tmp_path / "out", {}, inputs=[tmp_path])
    assert capsys.readouterr().err == f"warning: {newest}: damaged; step 1 of {tmp_path} is used instead\n"
    digest = files.file_sha256(tmp_path / "checkpoints" / "00000001" / "meta.json")
    options.finish(tmp_path / "out", {"x": 1}, {"seed": 0}, partial)
    settings = json.loads((tmp_path / "out" / "settings.json").read_text())
    assert settings["seed"] == 0 and settings["networks"] == {str(tmp_path): {"step": 1, "digest": digest}}


def test_one_step_is_taken_by_its_folder_or_by_its_number(tmp_path: pathlib.Path) -> None:
    first = _save(tmp_path, 1)
    _save(tmp_path, 2, seed=1)
    for given in (tmp_path / "checkpoints" / "00000001", f"{tmp_path}@1"):
        loaded = checkpoint.load_network(given, network="grasp")
        assert checkpoint.digest(loaded) == checkpoint.digest(first)
    with pytest.raises(UserError, match=r"@3: no such step of .*; it has 2, 1$"):
        checkpoint.load_network(f"{tmp_path}@3", network="grasp")
    with pytest.raises(
        UserError, match=r"no whole step under checkpoints/; give a run .*RUN@STEP.*RUN/checkpoints/STEP"
    ):
        checkpoint.load_network(tmp_path / "checkpoints", network="grasp")


def test_a_full_disk_is_one_line_and_leaves_no_litter(tmp_path: pathlib.Path) -> None:
    _save(tmp_path, 1)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))  # no file may grow beyond this: File too large
        with pytest.raises(UserError, match=r"step 2 cannot be saved \(File too large\)") as told:
            _save(tmp_path, 2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, old)
    assert "\n" not in str(told.value)
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] == ["00000001"]
    checkpoint.load_network(tmp_path, network="grasp")


@pytest.mark.parametrize("code", ["RESOURCE_EXHAUSTED", "UNKNOWN"])
def test_what_tensorstore_says_of_a_full_disk_is_understood(code: str) -> None:
    said = f"{code}: Error writing local file: Failed to write [OS error 28: ENOSPC No space left on device]"
    assert checkpoint._system_error(ValueError(said)) == "No space left on device"
    assert checkpoint._system_error(ValueError("another shape")) is None


def test_an_export_replaces_an_export_and_never_a_training(tmp_path: pathlib.Path) -> None:
    run, out, training = (tmp_path / name for name in ("run", "out", "training"))
    for step in (5, 9):
        _save(run, step)
        checkpoint.export(run, out, network="grasp")
    assert [path.name for path in (out / "checkpoints").iterdir()] == ["00000009"]
    parts = {"model": nnx.state(checkpoint.build("grasp", CONFIG)), "train": {"x": jnp.zeros(2)}}
    checkpoint.save(training, 1, parts, network="grasp", config=CONFIG, extra={})
    with pytest.raises(UserError, match=f"--out {training}: holds a training"):
        checkpoint.export(run, training, network="grasp")
    files.write_json(tmp_path / "begun" / "config.json", {})
    with pytest.raises(UserError, match="holds a training"):
        checkpoint.export(run, tmp_path / "begun", network="grasp")
    with owner.owned(out), pytest.raises(UserError, match="in use"):
        checkpoint.export(run, out, network="grasp")
    (step,) = (out / "checkpoints").iterdir()
    with pytest.raises(
        UserError,
        match=r"/train: cannot be read .* start from it by --init",
    ):
        checkpoint.restore(step, "train", {"x": jnp.zeros(2)})


def test_a_missing_device_is_not_taken_for_a_damaged_file(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _save(tmp_path, 1)
    monkeypatch.setattr(jax, "devices", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        stored_step.arrays(tmp_path / "checkpoints" / "00000001" / "model")


def test_a_step_that_may_not_be_read_is_not_taken_for_a_damaged_one(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The step before it would be used, and measured."""
    _save(tmp_path, 10)
    _save(tmp_path, 20)
    read = files.read_bytes

    def refuse(path: pathlib.Path) -> bytes:
        if "00000020" in path.parts:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return read(path)

    monkeypatch.setattr(files, "read_bytes", refuse)
    with pytest.raises(PermissionError, match=r"00000020/meta\.json"):
        checkpoint.load_network(tmp_path, network="grasp")
