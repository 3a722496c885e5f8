"""Bad input at the command line: one line on standard error, exit code 2, nothing half-written."""

import inspect
import os
import pathlib
import shutil
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
from dipn_jax.datagen import cli as datagen_cli
from dipn_jax.eval import cli as eval_cli
from dipn_jax.eval import options
from dipn_jax.train import cli as train_cli
from flax import nnx

from dipn_jax.commands import console
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.storage import checkpoint, shards

COMMANDS = {"datagen": datagen_cli.COMMANDS, "train": train_cli.COMMANDS, "eval": eval_cli.COMMANDS}


@pytest.fixture
def call(capfd: pytest.CaptureFixture[str]):
    def run(stage: str, *arguments: object) -> tuple[int, str]:
        code = console.run("test", COMMANDS[stage], [str(a) for a in arguments])
        return code, capfd.readouterr().err

    return run


def _one_line(result: tuple[int, str], says: str) -> None:
    code, error = result
    assert code == 2
    assert error.startswith("error: ") and error.count("\n") == 1, error
    assert says in error
    assert "Traceback" not in error


def test_a_name_with_a_line_break_is_quoted_on_one_line(call, tmp_path: pathlib.Path) -> None:
    named = tmp_path / "a\nb.json"
    _one_line(call("eval", "clear", "--method", "gn", "--cases", named, "--out", tmp_path / "c"), "a?b.json")
    named.write_text("{}")
    _one_line(call("eval", "merge", named, "--out", tmp_path / "c"), "a?b.json")


@pytest.mark.parametrize(
    ("stage", "words"),
    [
        ("datagen", ("images", "--episodes", 4, "--out")),
        ("datagen", ("export", "data", "--format", "npz", "--out")),
        ("datagen", ("info", "data", "--html")),
        ("train", ("grasp-pretrain", "--data", "data", "--out")),
        ("train", ("export", "--run", "builtin", "--out")),
        ("train", ("export", "--run", "builtin", "--format", "safetensors", "--out")),
        ("eval", ("clear", "--method", "gn", "--grasp-net", "builtin", "--out")),
        ("eval", ("merge", "data", "--out")),
        ("eval", ("clear", "--method", "gn", "--out", "c", "--cases")),
    ],
)
def test_a_link_to_itself(
    stage: str, words: tuple[object, ...], call, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    pathlib.Path("loop").symlink_to("loop")
    _one_line(call(stage, *words, "loop"), "loop: a link that leads back to itself")
    assert os.readlink("loop") == "loop" and os.listdir() == ["loop"]


def test_a_disk_that_names_a_file_with_a_line_break_is_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    def work() -> None:
        raise OSError(28, "No space left on device", "a\nb")

    _one_line((console.exit_code(work), capfd.readouterr().err), "a?b: No space left")


def test_a_negative_count(call, tmp_path: pathlib.Path) -> None:
    _one_line(call("datagen", "push", "--out", tmp_path / "d", "--episodes", "-5"), "--episodes -5")
    assert not (tmp_path / "d").exists()


def test_ranges_and_distances_that_contradict_themselves(call, tmp_path: pathlib.Path) -> None:
    out = ("datagen", "push", "--out", tmp_path / "d")
    _one_line(call(*out, "--scale", 1.1, 0.9), "--scale 1.1 0.9")
    _one_line(call(*out, "--distances", 0.2), "--distances 0.2")
    _one_line(call(*out, "--distances", 0.1, 0.1), "none twice")
    _one_line(call("datagen", "check-world", "--out", tmp_path / "d", "--engines", "bullet"), "--engines bullet")
    assert not (tmp_path / "d").exists()


def test_grasps_that_contradict_themselves(call, tmp_path: pathlib.Path) -> None:
    guided = ("datagen", "grasp", "--grasp-net", tmp_path, "--out", tmp_path / "d")
    _one_line(call(*guided, "--guided", 0.8, "--unsure", 0.5), "--guided 0.8 --unsure 0.5")
    random = ("datagen", "grasp", "--out", tmp_path / "d")
    _one_line(call(*random, "--unsure", 0.5), "give --grasp-net")
    _one_line(call(*guided), "no whole step under checkpoints/")
    _one_line(call("train", "grasp-online", "--out", tmp_path / "r", "--tables", 0), "--tables 0")
    _one_line(call("eval", "grasp", "--out", tmp_path / "e"), "give --grasp-net or --curve")
    _one_line(call("eval", "grasp", "--curve", tmp_path, "--out", tmp_path / "e"), "config.json")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder(call, tmp_path: pathlib.Path) -> None:
    nowhere = tmp_path / "nowhere"
    _one_line(call("datagen", "info", nowhere), "no manifest.json")
    _one_line(call("datagen", "repair", nowhere), "no such data set")
    _one_line(call("train", "push", "--data", nowhere, "--out", tmp_path / "r"), "no manifest.json")
    _one_line(call("eval", "prediction", "--push-net", nowhere, "--out", tmp_path / "e"), "no such folder")
    _one_line(call("eval", "clear", "--grasp-net", nowhere, "--out", tmp_path / "e"), "--push-net")
    _one_line(call("eval", "report", "--out", tmp_path / "e", "--clear", nowhere), "metrics.json")
    assert list(tmp_path.iterdir()) == []


def test_a_truncated_shard(call, data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> None:
    copy = pathlib.Path(shutil.copytree(data["push"], tmp_path / "push"))
    path = shards.shard_path(copy, 0)
    path.write_bytes(path.read_bytes()[:1000])
    _one_line(call("datagen", "verify", copy), "shard-00000.parquet")
    _one_line(call("train", "push", "--data", copy, "--out", tmp_path / "r"), "repair")
    assert not (tmp_path / "r").exists()


def test_an_unknown_shape_in_a_case_file(call, tmp_path: pathlib.Path) -> None:
    path = tmp_path / "cases.json"
    path.write_text('{"cases": [{"name": "a", "objects": [{"shape": "sphere"}]}]}')
    _one_line(
        call("eval", "clear", "--grasp-net", tmp_path, "--method", "gn", "--cases", path, "--out", tmp_path / "e"),
        "sphere",
    )


def test_a_checkpoint_of_another_architecture(call, tmp_path: pathlib.Path) -> None:
    config = GraspConfig(width=8)
    model = checkpoint.build("grasp", config)
    checkpoint.save(tmp_path / "r", 1, {"model": nnx.state(model)}, network="grasp", config=config, extra={})
    path = tmp_path / "r" / "checkpoints" / "00000001" / "meta.json"
    path.write_text(path.read_text().replace('"width": 8', '"width": 16'))
    _one_line(call("eval", "grasp", "--grasp-net", tmp_path / "r", "--out", tmp_path / "e"), "another architecture")
    _one_line(call("eval", "prediction", "--push-net", tmp_path / "r", "--out", tmp_path / "e"), "want dipn")
    assert not (tmp_path / "e").exists()


def test_numbers_out_of_range(call, tmp_path: pathlib.Path) -> None:
    clear = ("eval", "clear", "--grasp-net", tmp_path, "--out", tmp_path / "e")
    for option, value in (("--distances", "5"), ("--gamma", "nan"), ("--candidates", "0"), ("--seed", "-1")):
        _one_line(call(*clear, option, value), option)
    _one_line(call("datagen", "push", "--out", tmp_path / "d", "--actions", "100000"), "--actions")
    _one_line(call("datagen", "push", "--out", tmp_path / "d", "--objects", "0"), "--objects")
    _one_line(call("datagen", "push", "--out", tmp_path / "d", "--timestep", "0.003"), "timestep")
    assert list(tmp_path.iterdir()) == []


def test_an_out_that_is_a_file(call, tmp_path: pathlib.Path) -> None:
    (tmp_path / "file").touch()
    _one_line(call("datagen", "push", "--out", tmp_path / "file"), "is not a folder")
    _one_line(call("eval", "grasp", "--grasp-net", tmp_path, "--out", tmp_path / "file" / "x"), "is not a folder")
    _one_line(call("datagen", "info", tmp_path / "file"), "no manifest.json")


def test_an_option_that_does_not_exist_exits_with_2(call) -> None:
    with pytest.raises(SystemExit) as stop:
        call("datagen", "push", "--bananas", "3")
    assert stop.value.code == 2


def _help(stage: str, *command: str, capfd: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stop:
        console.run("test", COMMANDS[stage], [*command, "--help"])
    assert stop.value.code == 0
    return capfd.readouterr().out


@pytest.mark.parametrize("stage", COMMANDS)
def test_help_shows_examples(stage: str, capfd: pytest.CaptureFixture[str]) -> None:
    for name, command in COMMANDS[stage].items():
        text = _help(stage, name, capfd=capfd)
        assert len(text) > 300 or name in ("verify", "repair", "info")
        examples = [line for line in inspect.getdoc(command).splitlines() if line.startswith(f"  dipn-{stage} ")]
        assert examples or name in ("verify", "repair", "info")
        shown = text.splitlines()
        for example in examples:
            assert example in shown, f"{name}: an example does not stand on a line of its own"
        for line in shown:
            assert "dipn-" not in line or line.count(f"  dipn-{stage} ") <= 1, line


@pytest.mark.parametrize("stage", COMMANDS)
def test_help_breaks_no_line_where_the_source_does(
    stage: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "5000")  # so that help itself breaks no line
    for name in COMMANDS[stage]:
        boxed = [line.strip("│ ") for line in _help(stage, name, capfd=capfd).splitlines() if line.startswith("│")]
        assert len(boxed) > 1
        for line in boxed:
            assert line.startswith(("-", "─")) or line.endswith((".", ")")), f"{name}: {line} ends in mid-sentence"


@pytest.mark.parametrize("stage", COMMANDS)
def test_the_list_of_commands_has_a_sentence_for_each(stage: str, capfd: pytest.CaptureFixture[str]) -> None:
    text = " ".join(_help(stage, capfd=capfd).replace("│", " ").split())
    for command in COMMANDS[stage].values():
        assert inspect.getdoc(command).splitlines()[0] in text
    assert f"dipn-{stage} " not in text, "examples belong to the help of each command"


@pytest.mark.parametrize("stage", COMMANDS)
def test_help_imports_nothing_that_is_slow(stage: str) -> None:
    script = (
        f"import sys; from dipn_jax.{stage}.cli import COMMANDS; from dipn_jax.commands import console\n"
        "for arguments in [['--help'], *[[name, '--help'] for name in COMMANDS]]:\n"
        "    try: console.run('test', COMMANDS, arguments)\n"
        "    except SystemExit: pass\n"
        "slow = {'jax', 'jaxlib', 'flax', 'mujoco', 'numpy', 'matplotlib', 'pyarrow', 'orbax', 'cv2'}\n"
        "sys.exit(' '.join(slow & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_command_that_simulates_takes_threads(call, tmp_path: pathlib.Path) -> None:
    """And refuses none: none of them has begun, and none of them takes it for something that the result depends on."""
    net = ("--grasp-net", "builtin")
    simulating = {
        "datagen": (("push",), ("grasp",), ("images",), ("check-world",)),
        "train": (("grasp-online",), ("baseline",)),
        "eval": (("prediction", "--push-net", "builtin"), ("grasp", *net), ("clear", *net, "--method", "gn")),
    }
    for stage, commands in simulating.items():
        for words in commands:
            _one_line(call(stage, *words, "--out", tmp_path / "o", "--threads", "0"), "--threads 0: want at least 1")
    sweep = ("sweep", *net, "--push-net", "builtin", "--out", tmp_path / "o", "--threads", "0")
    _one_line(call("eval", *sweep), "--threads 0: want at least 1")
    assert not (tmp_path / "o").exists()
    assert options.settings({"seed": 1, "threads": 3}) == {"seed": 1}


def test_commands_without_threads_are_those_that_simulate_nothing() -> None:
    def takes(command: Callable[..., Any]) -> bool:
        given = inspect.signature(command).parameters
        work = getattr(given.get("work"), "default", None)
        return "threads" in given or hasattr(work, "threads")

    without = {stage: {name for name, one in known.items() if not takes(one)} for stage, known in COMMANDS.items()}
    assert without == {
        "datagen": {"verify", "repair", "info", "export", "merge"},
        "train": {"push", "grasp-pretrain", "grasp", "sweep", "export"},
        "eval": {"merge", "report"},
    }


@pytest.mark.parametrize(
    "platform", ["cuda", *(pytest.param(name, marks=pytest.mark.slow) for name in ("tpu", "bananas"))]
)
def test_a_device_that_is_not_there_is_one_line(platform: str, tmp_path: pathlib.Path) -> None:
    """Each command comes to JAX in its own way: its default device, a seed, a network."""
    scripts = [["datagen", "images"], ["train", "grasp-online"], ["eval", "grasp", "--grasp-net", "builtin"]]
    environment = os.environ | {"JAX_PLATFORMS": platform}
    commands = [
        [sys.executable, "-m", f"dipn_jax.{stage}.cli", *words, "--out", str(tmp_path / "o")]
        for stage, *words in scripts
    ]
    started = [subprocess.Popen(each, stderr=subprocess.PIPE, env=environment, text=True) for each in commands]
    for process in started:
        error = process.communicate()[1]
        _one_line((process.returncode, error), f"JAX_PLATFORMS={platform}: no such device here")


def test_too_little_memory_is_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    def large() -> None:
        raise MemoryError

    _one_line((console.exit_code(large), capfd.readouterr().err), "not enough memory")


def test_another_error_is_none_of_the_users() -> None:
    def broken() -> None:
        raise AssertionError("ours")

    with pytest.raises(AssertionError, match="ours"):
        console.exit_code(broken)


def test_a_closed_pipe_is_not_an_error() -> None:
    ours, theirs = os.pipe()
    os.close(ours)
    done = subprocess.run(
        [sys.executable, "-m", "dipn_jax.eval.cli", "--help"], stdout=theirs, stderr=subprocess.PIPE, check=False
    )
    os.close(theirs)
    assert done.returncode == 141 and not done.stderr
