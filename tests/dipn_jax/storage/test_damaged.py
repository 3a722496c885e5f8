"""Files that do not hold what they should are refused in one line, by everything that reads them, and repaired."""

import io
import json
import pathlib
import shutil
from collections.abc import Callable
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dipn_jax.datagen import cli as datagen_cli
from dipn_jax.train.push import PushTask

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.storage import accounting, checkpoint, layout, records, shards
from experiments import fuzzing

META = {"columns": {}, "schema_version": shards.SCHEMA_VERSION}


@pytest.fixture
def copy(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> pathlib.Path:
    return pathlib.Path(shutil.copytree(data["push"], tmp_path / "push"))


def _table(change: Callable[[pa.Table], pa.Table]) -> Callable[[bytes], bytes]:
    """Return what changes the table of a shard."""

    def changed(shard: bytes) -> bytes:
        sink = io.BytesIO()
        pq.write_table(change(pq.read_table(io.BytesIO(shard))), sink)
        return sink.getvalue()

    return changed


def _meta(*path: str, to: Any = None) -> Callable[[bytes], bytes]:
    """Return what sets, or without `to` deletes, an entry of the metadata of a shard."""

    def changed(shard: bytes) -> bytes:
        meta = fuzzing.meta_of(shard)
        inner = meta
        for key in path[:-1]:
            inner = inner[key]
        if to is None:
            del inner[path[-1]]
        else:
            inner[path[-1]] = to
        return fuzzing.with_meta(shard, meta)

    return changed


def _retyped(table: pa.Table) -> pa.Table:
    at = table.column_names.index("after")
    flat = table.column(at).combine_chunks()
    floats = pa.FixedSizeListArray.from_arrays(flat.flatten().cast(pa.float32(), safe=False), flat.type.list_size)
    return table.set_column(at, "after", floats)


def _emptied(table: pa.Table) -> pa.Table:
    rows = [None, *table.column("fault").to_pylist()[1:]]
    return table.set_column(table.column_names.index("fault"), "fault", pa.array(rows, pa.list_(pa.int32(), 1)))


DAMAGE: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "metadata {}": (lambda shard: fuzzing.with_meta(shard, b"{}"), "schema_version is missing"),
    "metadata no JSON": (lambda shard: fuzzing.with_meta(shard, b"{"), "metadata are damaged: not JSON"),
    "metadata null": (lambda shard: fuzzing.with_meta(shard, b"null"), "its content is null, want an object"),
    "no metadata": (_table(lambda table: table.replace_schema_metadata(None)), "schema_version is missing"),
    "no kind": (_meta("kind"), "kind is missing"),
    "another kind": (_meta("kind", to="images"), "column"),
    "no columns": (_meta("columns"), "columns is missing"),
    "no column in the metadata": (_meta("columns", "poses"), "its metadata has no column poses"),
    "a column more": (_meta("columns", "x", to={"dtype": "int32", "shape": []}), "which push episodes have not"),
    "no column": (_table(lambda table: table.drop_columns(["poses"])), "it has no column poses"),
    "a column twice": (_table(lambda t: t.append_column("fault", t.column("fault"))), "more than one column fault"),
    "another type": (_table(_retyped), r"its column after is of type fixed_size_list<element: float>\[21\], want"),
    "another dtype": (_meta("columns", "fault", "dtype", to="float32"), "its column fault is float32, want int"),
    "a dtype that is none": (_meta("columns", "fault", "dtype", to="object"), "fault.dtype is object, want one of"),
    "another shape": (_meta("columns", "after", "shape", to=[7, 3]), r"its column after has shape \[7, 3\], want N 7"),
    "other slots": (_meta("columns", "scene.mass", "shape", to=[4]), r"scene.mass has shape \[4\], want N with"),
    "no quantum": (_meta("columns", "poses", "quantum"), "poses is int32 with quantum None and code value, want"),
    "a huge quantum": (_meta("columns", "poses", "quantum", to=1e300), "with a quantum from 0 to 1"),
    "another code": (
        _meta("columns", "scene.mass", "code", to="delta"),
        "scene.mass is int32 with quantum .* and code",
    ),
    "counts that are none": (_meta("faults", "x", to=-1), "faults.x is -1, want a whole number"),
    "versions that are none": (_meta("versions", to=[1]), "versions is a list of 1, want an object"),
    "empty places": (_table(_emptied), "its column fault has empty places"),
    "no episodes": (_table(lambda table: table.slice(0, 0)), "it holds no episodes"),
    "not Parquet": (lambda shard: shard[:-1], "not a shard of this project|truncated, damaged or not Parquet"),
}


def _one_line(call: Callable[[], Any], says: str) -> None:
    with pytest.raises(UserError, match=says) as caught:
        call()
    assert "\n" not in str(caught.value)


def _command(*arguments: Any) -> int:
    return console.run("test", datagen_cli.COMMANDS, [str(each) for each in arguments])


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_shard_is_one_line_wherever_it_is_read_and_is_set_aside(
    damage: str, copy: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    accounting.save_command(copy, ["push", "--episodes", "24"], of=1)
    path = shards.shard_path(copy, 1)
    change, says = DAMAGE[damage]
    path.write_bytes(change(path.read_bytes()))
    for listed in (False, True):
        if listed:  # by somebody who knew the file as it is
            manifest = json.loads((copy / "manifest.json").read_text())
            entry = {"bytes": path.stat().st_size, "sha256": records.files.file_sha256(path)}
            manifest["shards"][path.name] |= entry
            (copy / "manifest.json").write_text(json.dumps(manifest))
        if not (listed and damage == "empty places"):  # which are seen where all of it is read
            capsys.readouterr()
            assert [found for found, _ in records.verify(copy)] == [path], "listed, not raised"
            assert _command("verify", copy) == 2
            said = capsys.readouterr().err
            assert said.count("\n") == 1 and "run dipn-datagen repair" in said and "shard-00001.parquet" in said
        learn = lambda: PushTask(copy, DipnConfig(), limit=None, centimetres=(10,)).train_set.whole()  # noqa: E731
        _one_line(learn, r"run dipn-datagen repair")
    _one_line(lambda: shards.read_shard(path, kind="push"), says)
    if damage != "empty places":
        _one_line(lambda: records.summary(copy), says)
    assert _command("repair", copy) == 0
    said = capsys.readouterr().out
    assert "1 damaged shards set aside: shard-00001.parquet" in said
    assert f"16 of 24 episodes, shard 1 missing: run `dipn-datagen push --episodes 24 --out {copy}`" in said
    assert path.with_suffix(".parquet.damaged").exists() and not path.exists()
    assert records.verify(copy) == [] and len(records.load(copy, kind="push")[0].fault) == 16


def test_a_shard_that_cannot_be_opened_is_not_damaged(copy: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for error in (PermissionError(13, "Permission denied"), MemoryError()):

        def fails(*_: Any, error: BaseException = error, **__: Any) -> None:
            raise error

        monkeypatch.setattr(pq, "read_metadata", fails)
        with pytest.raises(UserError, match=r"Permission denied|not enough memory"):
            records.repair(copy)
        assert shards.shard_path(copy, 0).exists()


def test_columns_follow_from_the_structs(copy: pathlib.Path) -> None:
    found = layout.columns(layout.KINDS["push"])
    assert found["poses"] == layout.Column("f", ("11", "N", "7")) and found["fault"] == layout.Column("i", ())
    assert layout.columns(layout.KINDS["grasp"])["held"] == layout.Column("b", ("N",))
    assert set(found) == set(pq.read_schema(shards.shard_path(copy, 0)).names)


@pytest.mark.parametrize(
    "name", ["../shard-00001.parquet", "/shard-00001.parquet", "shard-x/../../a.parquet", "a.parquet"]
)
def test_no_name_in_a_manifest_leads_out_of_the_folder(name: str, copy: pathlib.Path) -> None:
    shutil.copy(shards.shard_path(copy, 1), copy.parent / "shard-00001.parquet")
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["shards"] = {name: manifest["shards"]["shard-00001.parquet"]}
    (copy / "manifest.json").write_text(json.dumps(manifest))
    for look in (records.verify, records.summary, lambda at: records.load(at, kind="push")):
        _one_line(lambda look=look: look(copy), r"manifest\.json is damaged; run dipn-datagen repair")  # type: ignore[misc]
    assert records.repair(copy) == [] and records.verify(copy) == []


def test_a_shard_may_be_a_link_as_tools_for_large_files_make_them(copy: pathlib.Path) -> None:
    path = shards.shard_path(copy, 1)
    path.symlink_to(path.rename(copy.parent / "outside.parquet"))
    assert records.verify(copy) == [] and records.repair(copy) == [] and path.is_symlink()
    records.load(copy, kind="push")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"step": None}, "no whole step"),
        ({"step": -1}, "no whole step"),
        ({"network_config": [1]}, "no whole step"),
        ({"sha256": {"../x": "0"}}, "no whole step"),
        ({"sha256": ["model"]}, "no whole step"),
        ({"network": ["grasp"]}, "no whole step"),
        ({"network_config": {"width": "24"}}, "its config does not fit this version .width is 24, want a whole number"),
        ({"network_config": {"width": -3}}, "its config does not fit this version"),
        ({"network_config": {"stages": 3}}, "its config does not fit this version"),
        ({"network_config": {"preset": "huge"}}, "its config does not fit this version"),
        ({"network_config": {"de\npth": 3}}, r"its config does not fit this version .no option de\?pth"),
        ({"network_config": {"width": 60_000}}, "its config is of a larger network than its arrays"),
        ({"network_config": {"blocks": 48}}, "its config is of a larger network than its arrays"),
        ({"network_config": {"width": 25}}, "made for another architecture"),
    ],
)
def test_metadata_of_a_checkpoint_that_do_not_fit_are_one_line(
    changes: dict[str, Any], says: str, tmp_path: pathlib.Path
) -> None:
    shutil.copytree(checkpoint.find(pathlib.Path("builtin"), network="grasp"), tmp_path / "run")
    (path,) = (tmp_path / "run").rglob("meta.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    _one_line(lambda: checkpoint.load_network(tmp_path / "run", network="grasp"), says)


def test_a_checkpoint_without_its_arrays_is_one_line(tmp_path: pathlib.Path) -> None:
    shutil.copytree(checkpoint.find(pathlib.Path("builtin"), network="grasp"), tmp_path / "run")
    (path,) = (tmp_path / "run").rglob("meta.json")
    shutil.rmtree(path.parent / "model")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"sha256": {}}))
    _one_line(lambda: checkpoint.load_network(tmp_path / "run", network="grasp"), "cannot be read")


def test_a_file_outside_of_a_step_is_not_looked_at(tmp_path: pathlib.Path) -> None:
    shutil.copytree(checkpoint.find(pathlib.Path("builtin"), network="grasp"), tmp_path / "run")
    (path,) = (tmp_path / "run").rglob("meta.json")
    meta = json.loads(path.read_text())
    outside = (tmp_path / "secret").resolve()
    outside.write_text("x")
    for name in (str(outside), "../../../secret"):
        digest = records.files.file_sha256(outside)
        path.write_text(json.dumps(meta | {"sha256": {name: digest}}))
        assert checkpoint.newest(tmp_path / "run") is None
