"""Learning curves: which run is which, the arithmetic of the band, and the page in docs."""

import importlib.util
import json
import pathlib

import numpy as np
import pytest
from dipn_jax.eval.prediction import curve
from flax import nnx

from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.storage import checkpoint

DOCS = pathlib.Path(__file__).parent.parent.parent / "docs"


def _run(folder: pathlib.Path, extra: dict[str, int]) -> pathlib.Path:
    config = DipnConfig(width=8, features=16)
    state = {"model": nnx.state(checkpoint.build("dipn", config))}
    checkpoint.save(folder, 1, state, network="dipn", config=config, extra=extra)
    return folder


def test_runs_are_told_apart_by_pushes_and_seed(tmp_path: pathlib.Path) -> None:
    runs = [_run(tmp_path / str(n), {"examples": n, "seed": 1}) for n in (1500, 100)]
    assert list(curve.load(runs)) == ["100/1", "1500/1"]
    with pytest.raises(UserError, match="a second run of 100 pushes with seed 1"):
        curve.load([*runs, runs[1]])
    with pytest.raises(UserError, match="does not say how many pushes"):
        curve.load([_run(tmp_path / "old", {})])


def _values() -> dict[str, float]:
    errors = {"100/0": 0.3, "100/1": 0.5, "1500/0": 0.1, "trans": 0.6}
    return {
        f"push_error/{name}/{at}/{which}": error
        for name, error in errors.items()
        for at in ("5cm", "10cm")
        for which in ("all", "moved")
    }


def test_the_band_is_the_spread_of_a_sample() -> None:
    made = curve.summary(_values(), ["100/0", "100/1", "1500/0"])
    assert made["push_error/curve/100/5cm/all/mean"] == pytest.approx(0.4)
    assert made["push_error/curve/100/5cm/all/std"] == pytest.approx(np.sqrt(0.02))
    assert made["push_error/curve/1500/10cm/moved/std"] == 0 and made["push_error/curve/100/5cm/all/seeds"] == 2


def test_the_table_has_a_row_for_each_predictor() -> None:
    values = _values()
    rows = curve.table(values | curve.summary(values, ["100/0", "100/1", "1500/0"])).splitlines()
    assert rows[0] == "| predictor | 1 - IoU, 5 cm | 1 - IoU, 10 cm |"
    assert rows[2] == "| DIPN, 100 pushes | 0.400 ± 0.141 | 0.400 ± 0.141 |"
    assert rows[3] == "| DIPN, 1,500 pushes | 0.100 | 0.100 |"
    assert rows[4:] == ["| `trans` | 0.600 | 0.600 |"]


def test_the_page_in_docs_shows_the_figures_in_docs() -> None:
    place = importlib.util.spec_from_file_location("push_prediction", DOCS / "push_prediction.py")
    assert place is not None and place.loader is not None
    page = importlib.util.module_from_spec(place)
    place.loader.exec_module(page)
    text = (DOCS / "push-prediction.md").read_text()
    for table in page.tables(json.loads((DOCS / "push-prediction.json").read_text())):
        assert table in text
