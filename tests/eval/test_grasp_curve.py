"""Learning curves of grasping: means and bands over seeds; the page in docs shows the figures in docs."""

import importlib.util
import json
import pathlib

import pytest
from dipn_jax.eval.grasping import curve

from dipn_jax.errors import UserError

DOCS = pathlib.Path(__file__).parents[2] / "docs"


def _run(folder: pathlib.Path, pretrained: bool, success: list[float]) -> pathlib.Path:
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({"pretrained": pretrained}))
    rows = [json.dumps({"step": 10 * (i + 1), "success": value}) for i, value in enumerate(success)]
    (folder / "metrics.jsonl").write_text("\n".join(rows) + "\n")
    return folder


def test_mean_and_band_over_seeds(tmp_path: pathlib.Path) -> None:
    runs = [_run(tmp_path / "a", True, [0.5, 0.9]), _run(tmp_path / "b", True, [0.7, 1.0])]
    values = curve.summary(curve.load([*runs, _run(tmp_path / "c", False, [0.2])]))
    assert values["online/with/10/mean"] == pytest.approx(0.6) and values["online/with/20/seeds"] == 2
    assert values["online/with/10/std"] == pytest.approx(0.2 / 2**0.5)
    assert values["online/without/10/std"] == 0 and "online/without/20/mean" not in values
    assert "| with pre-training | 0.600 ± 0.141 | 0.950 ± 0.071 |" in curve.table(values, [10, 20])
    axis = curve.figure(values).axes[0]
    assert [text.get_text() for text in axis.get_legend().get_texts()] == [
        "with pre-training, 2 seeds",
        "without pre-training, 1 seeds",
    ]


def test_another_run_is_refused(tmp_path: pathlib.Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(UserError, match="no run of dipn-train grasp-online"):
        curve.load([tmp_path])


def test_the_page_in_docs_shows_the_figures_in_docs() -> None:
    place = importlib.util.spec_from_file_location("grasping_page", DOCS / "grasping.py")
    assert place is not None and place.loader is not None
    page = importlib.util.module_from_spec(place)
    place.loader.exec_module(page)
    text = (DOCS / "grasping.md").read_text()
    for table in page.tables(json.loads((DOCS / "grasping.json").read_text())):
        assert table in text
