"""Learning curves: how runs are grouped, the arithmetic of the band, and the page in docs."""

import json
import pathlib

import numpy as np
import pytest
from dipn_jax.eval import curves
from flax import nnx

from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.storage import checkpoint

DOCS = pathlib.Path(__file__).parents[2] / "docs"


def _push_run(folder: pathlib.Path, extra: dict[str, int]) -> pathlib.Path:
    config = DipnConfig(width=8, features=16)
    state = {"model": nnx.state(checkpoint.build("dipn", config))}
    checkpoint.save(folder, 1, state, network="dipn", config=config, extra=extra)
    return folder


def test_runs_are_distinguished_by_pushes_and_seed(tmp_path: pathlib.Path) -> None:
    runs = [_push_run(tmp_path / str(n), {"examples": n, "seed": 1}) for n in (1500, 100)]
    assert list(curves.load_push_runs(runs)) == ["100/1", "1500/1"]
    with pytest.raises(UserError, match="a second run of 100 pushes with seed 1"):
        curves.load_push_runs([*runs, runs[1]])
    with pytest.raises(UserError, match="does not name its number of pushes"):
        curves.load_push_runs([_push_run(tmp_path / "old", {})])


def _values() -> dict[str, float]:
    errors = {"100/0": 0.3, "100/1": 0.5, "1500/0": 0.1, "trans": 0.6}
    return {
        f"push_error/{name}/{at}/{which}": error
        for name, error in errors.items()
        for at in ("5cm", "10cm")
        for which in ("all", "moved")
    }


def test_the_band_is_the_spread_of_a_sample() -> None:
    made = curves.push_summary(_values(), ["100/0", "100/1", "1500/0"])
    assert made["push_error/curve/100/5cm/all/mean"] == pytest.approx(0.4)
    assert made["push_error/curve/100/5cm/all/std"] == pytest.approx(np.sqrt(0.02))
    assert made["push_error/curve/1500/10cm/moved/std"] == 0 and made["push_error/curve/100/5cm/all/seeds"] == 2


def test_the_table_has_a_row_for_each_predictor() -> None:
    values = _values()
    rows = curves.push_table(values | curves.push_summary(values, ["100/0", "100/1", "1500/0"])).splitlines()
    assert rows[0] == "| predictor | 1 - IoU, 5 cm | 1 - IoU, 10 cm |"
    assert rows[2] == "| DIPN, 100 pushes | 0.400 ± 0.141 | 0.400 ± 0.141 |"
    assert rows[3] == "| DIPN, 1,500 pushes | 0.100 | 0.100 |"
    assert rows[4:] == ["| `trans` | 0.600 | 0.600 |"]


def _grasp_run(folder: pathlib.Path, pretrained: bool, success: list[float]) -> pathlib.Path:
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({"pretrained": pretrained}))
    rows = [json.dumps({"step": 10 * (i + 1), "success": value}) for i, value in enumerate(success)]
    (folder / "metrics.jsonl").write_text("\n".join(rows) + "\n")
    return folder


def test_mean_and_band_over_seeds(tmp_path: pathlib.Path) -> None:
    runs = [_grasp_run(tmp_path / "a", True, [0.5, 0.9]), _grasp_run(tmp_path / "b", True, [0.7, 1.0])]
    values = curves.grasp_summary(curves.load_grasp_runs([*runs, _grasp_run(tmp_path / "c", False, [0.2])]))
    assert values["online/with/10/mean"] == pytest.approx(0.6) and values["online/with/20/seeds"] == 2
    assert values["online/with/10/std"] == pytest.approx(0.2 / 2**0.5)
    assert values["online/without/10/std"] == 0 and "online/without/20/mean" not in values
    assert "| with pre-training | 0.600 ± 0.141 | 0.950 ± 0.071 |" in curves.grasp_table(values, [10, 20])
    axis = curves.grasp_figure(values).axes[0]
    assert [text.get_text() for text in axis.get_legend().get_texts()] == [
        "with pre-training, 2 seeds",
        "without pre-training, 1 seeds",
    ]


def test_another_run_is_refused(tmp_path: pathlib.Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(UserError, match=r"config\.json: a file, not the folder of a run"):
        curves.load_grasp_runs([tmp_path / "config.json"])
    with pytest.raises(UserError, match="no run of dipn-train grasp-online"):
        curves.load_grasp_runs([tmp_path])
