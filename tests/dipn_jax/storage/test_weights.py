"""Exported weights: every array by its name, and metadata that say what the network takes and returns."""

import json
import pathlib
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dipn_jax.train import cli
from flax import nnx
from safetensors import safe_open

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.networks import push_frame
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.networks.vpg import VpgConfig
from dipn_jax.storage import checkpoint, stored_step, weights
from dipn_jax.system import files

SHORT = (1, 1, 1, 1)
CONFIGS = {
    "dipn": ("dipn", DipnConfig(width=8)),
    "dipn paper": ("dipn", DipnConfig("paper", stages=SHORT)),
    "grasp": ("grasp", GraspConfig(width=8, coarse=8, blocks=1)),
    "grasp paper": ("grasp", GraspConfig("paper", stages=SHORT)),
    "vpg": ("vpg", VpgConfig(width=8, coarse=8)),
    "rea": ("vpg", VpgConfig(parts=("grasp",), answers="chance", width=8, coarse=8)),
    "dqn": ("vpg", VpgConfig(parts=("push",), width=8, coarse=8)),
    "vpg paper": ("vpg", VpgConfig("paper", blocks=SHORT)),
}


def saved(run: pathlib.Path, network: str, config: Any) -> nnx.Module:
    model = checkpoint.build(network, config)
    checkpoint.save(run, 7, {"model": nnx.state(model)}, network=network, config=config, extra={"seed": 0})
    model.eval()
    return model


def read(path: pathlib.Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    with safe_open(path, "numpy") as file:
        return file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


def outputs(network: str, model: Any, arrays: dict[str, np.ndarray], sizes: dict[str, int]) -> dict[str, Any]:
    """What a network returns for arrays of the names and shapes in the metadata."""
    if network == "grasp":
        return {"grasps": model(jnp.asarray(arrays["images"]))}
    if network == "vpg":
        parts = {"push": "pushes", "grasp": "grasps"}
        return {parts[name]: getattr(model, name)(jnp.asarray(arrays["images"])) for name in model.config.parts}
    b, n = sizes["B"], sizes["N"]
    absent = {"outlines": np.zeros((b, n, 0, 2)), "push_map": np.zeros((b, 0, 0)), "scene_map": np.zeros((b, 0, 0))}
    given = absent | arrays | {"present": np.ones((b, n), bool)}
    distances = given.pop("distances")
    return {"motions": model(push_frame.PushInput(**given), distances)}


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.slow if "paper" in kind else ()) for kind in CONFIGS]
)
def test_a_file_holds_every_array_and_says_what_goes_in_and_out(kind: str, tmp_path: pathlib.Path) -> None:
    network, config = CONFIGS[kind]
    model = saved(tmp_path / "run", network, config)
    weights.write(tmp_path / "run", tmp_path / "w.safetensors", network=network)
    about, stored = read(tmp_path / "w.safetensors")
    state = nnx.state(model, (nnx.Param, nnx.BatchStat))
    wanted = {".".join(map(str, path)): np.asarray(leaf[...]) for path, leaf in nnx.to_flat_state(state)}
    assert stored.keys() == wanted.keys() and len(stored) > 5
    for name, value in wanted.items():
        np.testing.assert_array_equal(stored[name], value, err_msg=name)
    assert any(name.endswith(".mean") for name in stored) == ("paper" in kind), "batch statistics"
    assert about["network"] == network and about["step"] == "7" and about["format"] == weights.FORMAT
    assert about["weights_sha256"] == checkpoint.digest(model) and "HWIO" in about["layout"]
    assert about["run_sha256"] == checkpoint.used(tmp_path / "run")["digest"]  # type: ignore[index]
    assert stored_step.config(checkpoint.NETWORKS[network][0], json.loads(about["config"])) == config
    sizes = {"B": 1, "H": 64, "W": 32, "N": 3, "K": 2}
    shapes = {
        end: {name: [sizes.get(side, side) for side in one["shape"]] for name, one in json.loads(about[end]).items()}
        for end in ("inputs", "outputs")
    }
    arrays = {name: np.zeros(shape, np.float32) for name, shape in shapes["inputs"].items()}
    found = jax.eval_shape(lambda: outputs(network, model, arrays, sizes))
    assert {name: list(value.shape) for name, value in found.items()} == shapes["outputs"]


def test_answers_are_called_what_they_are(tmp_path: pathlib.Path) -> None:
    for kind, says in (("grasp", "logit"), ("rea", "logit"), ("vpg", "value"), ("dqn", "value")):
        network, config = CONFIGS[kind]
        saved(tmp_path / kind, network, config)
        weights.write(tmp_path / kind, tmp_path / "w.safetensors", network=network)
        outputs = json.loads(read(tmp_path / "w.safetensors")[0]["outputs"])
        assert all(one["meaning"].startswith(says) for one in outputs.values())
        assert [*outputs] == {"vpg": ["pushes", "grasps"], "dqn": ["pushes"]}.get(kind, ["grasps"])


def test_constants_are_those_of_the_network(tmp_path: pathlib.Path) -> None:
    """What its body gets is the image less the offset, over the scale."""
    weights.write(pathlib.Path("builtin"), tmp_path / "w.safetensors", network="grasp")
    about, stored = read(tmp_path / "w.safetensors")
    constants = json.loads(about["constants"])
    image = np.tile(np.array(constants["input_offset"], np.float32), (1, 8, 8, 1))
    model: Any = checkpoint.load_network("builtin", network="grasp")
    scaled = image + 0.3 * np.array(constants["input_scale"], np.float32)
    seen: list[Any] = []

    def body(x: Any) -> Any:
        seen.append(np.asarray(x))
        return x[..., 0]

    model.body = body
    model(jnp.asarray(image)), model(jnp.asarray(scaled))
    np.testing.assert_allclose(seen[0], 0, atol=1e-6)
    np.testing.assert_allclose(seen[1], 0.3, atol=1e-6)
    assert stored["body.stem.kernel"].shape == (3, 3, 4 * constants["cell_pixels"] ** 2, 24)


def test_the_command_writes_the_same_file_again(tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["export", "--run", "builtin", "--network", "dipn", "--format", "safetensors", "--out"]
    for name in ("a.safetensors", "b.safetensors"):
        assert console.run("test", cli.COMMANDS, [*words, str(tmp_path / "new" / name)]) == 0
    assert files.file_sha256(tmp_path / "new" / "a.safetensors") == files.file_sha256(
        tmp_path / "new" / "b.safetensors"
    )
    capfd.readouterr()
    other = tmp_path / "new" / "shard-00000.parquet"
    other.write_text("pushes")
    for out, more, says in (
        (tmp_path, (), "a folder; give the name of a file"),
        (tmp_path / "new" / "a.safetensors" / "c.safetensors", (), "is not a folder"),
        (other, (), "want a file whose name ends in .safetensors"),
        (tmp_path / "v.safetensors", ("--network", "vpg"), "no vpg network comes with this package"),
        (tmp_path / "v.safetensors", ("--run", str(tmp_path / "nowhere")), "no such folder"),
    ):
        assert console.run("test", cli.COMMANDS, [*words, str(out), *more]) == 2
        error = capfd.readouterr().err
        assert says in error and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["new"] and other.read_text() == "pushes"


def test_a_file_is_read_without_jax(tmp_path: pathlib.Path) -> None:
    weights.write(pathlib.Path("builtin"), tmp_path / "w.safetensors", network="grasp")
    script = (
        "import sys; from safetensors import safe_open; file = safe_open(sys.argv[1], 'numpy'); "
        "assert file.get_tensor('body.out.bias').shape == (16,); assert not {'jax', 'flax'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script, str(tmp_path / "w.safetensors")], check=True)


def test_a_run_of_another_network_is_refused(tmp_path: pathlib.Path) -> None:
    saved(tmp_path / "run", *CONFIGS["grasp"])
    with pytest.raises(UserError, match="holds a grasp network, want dipn"):
        weights.write(tmp_path / "run", tmp_path / "w.safetensors", network="dipn")
    assert not (tmp_path / "w.safetensors").exists()
