"""Ten minutes on a GPU: how stages run, fail, are kept and continued, and a rehearsal of all of them on the CPU."""

import json
import pathlib
import sys
import types
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from benchmarks import (
    encoding,
    gpu_engines,
    gpu_process,
    gpu_profile,
    gpu_stage,
    gpu_variants,
    on_gpu,
    page,
)
from benchmarks.gpu_record import Stage
from dipn_jax import structs
from dipn_jax.storage import records
from dipn_jax.structs import Rollout
from dipn_jax.world import shapes

PROCESS = """
import json, os, sys, time

def say(**answer):
    print(json.dumps(answer), flush=True)

device = os.environ.get("DEVICE", "d")
say(machine={"processor": "p", "cores": 2, "devices": [device], "python": "3", "versions": {}, "commit": "c"})
for line in sys.stdin:
    name = json.loads(line)["stage"]
    with open(os.environ["ASKED"], "a") as asked:
        asked.write(name + "\\n")
    say(figure=f"{name}/first", value=1.0)
    if name == "dies" and not os.path.exists(os.environ["ASKED"] + ".healed"):
        os._exit(7)
    if name == "hangs":
        time.sleep(100)
    say(note=f"{name}/second", text="not measured: no")
    say(ended="failed: RuntimeError: no" if name == "fails" else "measured", compiling=0.5)
"""
"""A process that speaks as `gpu_stage` does, without JAX."""


@pytest.fixture
def stages(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Make `on_gpu` run these stages with `PROCESS`; names with a `!` are checks. Returns what has been asked for."""
    (tmp_path / "process.py").write_text(PROCESS)
    monkeypatch.setenv("ASKED", str(tmp_path / "asked"))
    monkeypatch.setattr(gpu_process, "COMMAND", (sys.executable, str(tmp_path / "process.py")))
    monkeypatch.setattr(on_gpu, "GRACE_SECONDS", 0.0)

    def use(*names: str) -> list[str]:
        made = {name.strip("!"): Stage("a stage", "nowhere:f", 60, is_check="!" in name) for name in names}
        monkeypatch.setattr(on_gpu, "STAGES", made)
        return [line for path in [tmp_path / "asked"] if path.exists() for line in path.read_text().split()]

    return use


def test_a_stage_that_fails_or_dies_is_a_line_and_the_others_go_on(
    stages: Callable[..., list[str]], tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stages("good!", "fails", "dies", "after!")
    assert on_gpu.main(["--out", str(tmp_path / "a.json")]) == 0
    kept = json.loads((tmp_path / "a.json").read_text())
    assert {name: entry["state"] for name, entry in kept["stages"].items()} == {
        "good": "measured",
        "fails": "failed: RuntimeError: no",
        "dies": "failed: its process ended with code 7",
        "after": "measured",
    }
    assert kept["figures"] == {f"{name}/first": 1.0 for name in ("good", "fails", "dies", "after")}
    assert kept["notes"]["fails"] == "failed: RuntimeError: no" and kept["notes"]["good/second"] == "not measured: no"
    (machine,) = kept["machine"]
    assert machine["devices"] == ["d"] and machine["rows"] == "good, fails, dies, after" and machine["scale"] == "full"
    assert "| `good/first` |  | 1 |" in page.tables(
        kept["figures"]
    ) and "| good, fails, dies, after | p, 2 cores, d | c |" in (page.origins(kept))
    table = capsys.readouterr().out.splitlines()[-4:]
    assert [line.split()[0] for line in table] == ["good", "fails", "dies", "after"]


def test_a_check_that_fails_is_the_exit_code(stages: Callable[..., list[str]], tmp_path: pathlib.Path) -> None:
    stages("fails!", "good")
    assert on_gpu.main(["--out", str(tmp_path / "a.json")]) == 1


def test_the_same_command_measures_what_is_missing(stages: Callable[..., list[str]], tmp_path: pathlib.Path) -> None:
    stages("good", "dies", "new")
    on_gpu.main(["--out", str(tmp_path / "a.json")])
    (tmp_path / "asked.healed").touch()
    assert on_gpu.main(["--out", str(tmp_path / "a.json")]) == 0
    assert stages() == ["good", "dies", "new", "dies"]
    kept = json.loads((tmp_path / "a.json").read_text())
    assert kept["stages"]["dies"]["state"] == "measured" and "dies" not in kept["notes"]


def test_what_takes_too_long_is_ended_and_what_is_left_is_not_begun(
    stages: Callable[..., list[str]], tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stages("hangs", "never")
    assert on_gpu.main(["--out", str(tmp_path / "a.json"), "--minutes", "0.09"]) == 0
    kept = json.loads((tmp_path / "a.json").read_text())
    assert kept["stages"]["hangs"]["state"].startswith("failed: not done after") and "never" not in kept["stages"]
    assert kept["figures"] == {"hangs/first": 1.0}
    assert capsys.readouterr().out.splitlines()[-1].endswith("not measured")


@pytest.mark.parametrize("content", ["{", '{"figures": 1}'])
def test_a_file_that_is_something_else_is_refused_in_one_line(
    content: str, stages: Callable[..., list[str]], tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.json").write_text(content)
    assert on_gpu.main(["--out", str(tmp_path / "a.json")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and (tmp_path / "a.json").read_text() == content


def test_a_rehearsal_is_not_continued_on_a_gpu(
    stages: Callable[..., list[str]], tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stages("good")
    assert on_gpu.main(["--out", str(tmp_path / "a.json"), "--toy"]) == 0
    assert on_gpu.main(["--out", str(tmp_path / "a.json")]) == 2
    assert "begun with scale toy, asked for full; give another --out" in capsys.readouterr().err


def test_without_a_gpu_only_a_rehearsal_begins(
    stages: Callable[..., list[str]],
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stages("good")
    monkeypatch.setenv("DEVICE", "cpu")
    assert on_gpu.main(["--out", str(tmp_path / "a.json")]) == 2
    assert capsys.readouterr().err.startswith("error: on_gpu: JAX finds no GPU here; ")
    assert not (tmp_path / "a.json").exists()
    assert on_gpu.main(["--out", str(tmp_path / "a.json"), "--toy"]) == 0


def _measured(work: Callable[[Any], Iterator[Any]], seconds: float, monkeypatch: pytest.MonkeyPatch) -> tuple[str, Any]:
    """Return how a stage ended, and what it said."""
    monkeypatch.setitem(sys.modules, "benchmarks.staged", types.SimpleNamespace(work=work))  # type: ignore[arg-type]
    said: list[Any] = []
    request = {"stage": "on_gpu.x", "place": "staged:work", "seconds": seconds, "toy": True, "seed": 3}
    return gpu_stage.measure(request, said.append), said


def test_a_stage_says_figures_texts_and_how_it_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    def works(size: gpu_stage.Size) -> Iterator[Any]:
        yield "", size.seed
        yield "a", "some text"
        yield "b", np.nan

    def fails(size: gpu_stage.Size) -> Iterator[Any]:
        yield "", 1.0
        raise ValueError("two\nlines")

    def is_wrong(size: gpu_stage.Size) -> Iterator[Any]:
        yield "", 1.0
        raise gpu_stage.Wrong("3 came; want 4")

    def cannot(size: gpu_stage.Size) -> Iterator[Any]:
        yield "", 1.0
        raise gpu_stage.NotMeasured("no such engine")

    assert _measured(works, 9.0, monkeypatch) == (
        "measured",
        [
            {"figure": "on_gpu.x", "value": 3.0},
            {"note": "on_gpu.x/a", "text": "some text"},
            {"note": "on_gpu.x/b", "text": "not measured: it came out as nan"},
        ],
    )
    assert _measured(fails, 9.0, monkeypatch)[0] == "failed: ValueError: two lines"
    assert _measured(is_wrong, 9.0, monkeypatch)[0] == "failed: 3 came; want 4"
    assert _measured(cannot, 9.0, monkeypatch)[0] == "not measured: no such engine"
    ended, said = _measured(works, -1.0, monkeypatch)
    assert ended.startswith("partly measured") and len(said) == 1


def test_time_for_compiling_is_counted_once() -> None:
    compiling = gpu_stage.Compiling()
    compiling._spans = [(0.0, 2.0), (1.0, 3.0), (1.5, 1.6), (5.0, 6.0)]
    assert compiling.taken() == 4.0 and compiling.taken() == 0.0


class _Doubling:
    """An engine that notes how many scenes it gets, and returns their numbers twice."""

    name, config, batch = "mjx", None, 8

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def simulate(self, scenes: Any, poses: Any, trajectories: Any, samples: Any, **_: Any) -> Any:
        self.sizes.append(len(poses))
        assert len(scenes) == len(trajectories) == len(poses)
        return {"twice": 2 * poses}


def test_an_engine_is_given_batches_of_two_sizes() -> None:
    inner: Any = _Doubling()
    padded = gpu_engines.Padded(inner, small=4, full=8)
    for count in (1, 4, 5, 8, 9):
        rows = np.arange(count)
        found: Any = padded.simulate(rows, rows, rows, np.zeros(1))  # type: ignore[arg-type]
        np.testing.assert_array_equal(found["twice"], 2 * rows)
    assert inner.sizes == [4, 4, 8, 8, 16]


def test_a_variant_is_made_with_its_settings_or_not_available(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = gpu_variants.variant("mjx/iterations_15", batch=4)
    assert engine.config.iterations == 15 and engine.config.cone == "elliptic" and engine.chunk == 4  # type: ignore[attr-defined]
    for changes in ({"rockets": 3}, {gpu_variants.CONFIG: {"rockets": 3}}):
        monkeypatch.setitem(gpu_variants.ALL, "mjx/odd", changes)
        with pytest.raises(gpu_stage.NotMeasured, match="not available: MjxEngine has no setting rockets"):
            gpu_variants.variant("mjx/odd", batch=4)
    with pytest.raises(gpu_stage.NotMeasured, match=r"not available: .* power of two"):
        gpu_variants.variant("mjx/as_is", batch=3)


def _plane(name: str, **lines: list[tuple[str, float]]) -> Any:
    """Return a plane of a profile, with the events of its lines: name and milliseconds."""
    event = lambda name, taken: types.SimpleNamespace(name=name, duration_ns=1e6 * taken)  # noqa: E731
    rows = [types.SimpleNamespace(name=row, events=[event(*each) for each in found]) for row, found in lines.items()]
    return types.SimpleNamespace(name=name, lines=rows)


def test_kernels_of_a_profile_are_summed_and_the_largest_are_shown() -> None:
    host = _plane("/host:CPU", Stream=[("host", 100.0)])
    device = _plane(
        "/device:GPU:0", Stream1=[("a", 1.0), ("b", 3.0)], Stream2=[("a", 1.0)], **{"XLA Ops": [("a", 9.0)]}
    )
    times = gpu_profile.kernels(types.SimpleNamespace(planes=[host, device]), plane=gpu_profile.DEVICE)
    assert times == {"a": (2, 2.0), "b": (1, 3.0)}
    assert gpu_profile.largest(times) == ["60.0%, 3.000 ms, 1 times: b", "40.0%, 2.000 ms, 2 times: a"]
    only_operations = _plane("/device:GPU:0", **{"XLA Ops": [("a", 9.0)]})
    assert gpu_profile.kernels(types.SimpleNamespace(planes=[only_operations]), plane=gpu_profile.DEVICE) == {
        "a": (1, 9.0)
    }
    with pytest.raises(gpu_stage.NotMeasured, match="only of /host:CPU"):
        gpu_profile.kernels(types.SimpleNamespace(planes=[host]), plane=gpu_profile.DEVICE)


def test_synthetic_episodes_are_real_ones_elsewhere(data: Any) -> None:
    real: Any = structs.take(records.read_episodes(data["push"]), slice(0, 3))
    made = encoding.synthetic(real, 7, seed=0)
    assert made.poses.shape == (7, *real.poses.shape[1:]) and made.after.shape == (7, *real.after.shape[1:])
    assert len(np.unique(made.poses[:, 0, 0, 0])) == 7, "no two are alike"
    moved = made.poses[3] - made.poses[0]
    np.testing.assert_allclose(moved, np.broadcast_to(moved[:1, :1], moved.shape), atol=1e-6)
    np.testing.assert_allclose(made.after[3] - made.after[0], moved[0], atol=1e-6)


def test_an_engine_without_physics_sets_objects_on_the_table(settled: Any) -> None:
    poses = np.array(settled.poses)
    poses[..., 2] += 0.3
    rollout: Rollout = encoding.Resting().simulate(settled.scene, poses, None, np.zeros(3))  # type: ignore[arg-type]
    assert rollout.poses.shape == (len(poses), 3, *poses.shape[1:]) and not np.asarray(rollout.fault).any()
    for at in range(3):
        low = shapes.lowest_corner(settled.scene.shape, settled.scene.size, np.asarray(rollout.poses)[:, at], xp=np)
        np.testing.assert_allclose(low, 0.0, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(rollout.poses)[:, 0, :, :2], poses[..., :2])


@pytest.mark.slow
def test_all_stages_run_as_small_as_can_be(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert on_gpu.main(["--toy", "--minutes", "30", "--out", str(tmp_path / "a.json")]) == 0
    kept = json.loads((tmp_path / "a.json").read_text())
    states = {name: entry["state"] for name, entry in kept["stages"].items()}
    assert states.pop("on_gpu.profile") == "not measured: no profile shows kernels of a device", kept["notes"]
    assert {*states, "on_gpu.profile"} == set(on_gpu.STAGES)
    assert set(states.values()) == {"measured"}, states
    assert not [text for text in kept["notes"].values() if text.startswith("failed")]
    (machine,) = kept["machine"]
    assert {"processor", "cores", "devices", "commit", "versions", "platform"} <= machine.keys()
    for stage in set(on_gpu.STAGES) - {"on_gpu.profile", "on_gpu.training"}:
        assert kept["figures"][stage] > 0, stage
    ratio = kept["figures"]["on_gpu.push_episodes_vs_native/mjx_episodes_per_second"]
    native = kept["figures"]["on_gpu.push_episodes_vs_native/native_episodes_per_second"]
    assert kept["figures"]["on_gpu.push_episodes_vs_native/mjx"] == pytest.approx(ratio / native)
    for kernel in (
        "push_episodes_vs_native/mjx_warp",
        "reproducible/mjx_warp",
        "variants/mjx/warp_kernel/scene_seconds",
    ):
        assert kept["figures"][f"on_gpu.{kernel}"] > 0
    assert capsys.readouterr().out.splitlines()[-len(on_gpu.STAGES)].startswith("on_gpu.weights")
