import json
import pathlib
from typing import Any

import numpy as np
from dipn_jax.eval import metrics
from dipn_jax.eval.prediction import push_errors
from dipn_jax.eval.report import page

from dipn_jax.storage import checkpoint
from dipn_jax.storage.resume import Partial
from dipn_jax.world import scenes

CONFIG = scenes.fixed_count(3, spread=0.2)


def test_learning_curves_show_the_measures_that_exist(tmp_path: pathlib.Path) -> None:
    lines = [{"step": 10, "reward/grasp": 0.5}, {"step": 20, "reward/push": 0.25}, {"step": 30, "reward/grasp": 0.75}]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    drawn = {line.get_label(): line.get_xydata().tolist() for line in page._curves([tmp_path]).axes[0].lines}
    assert drawn == {"reward/grasp": [[10, 0.5], [30, 0.75]], "reward/push": [[20, 0.25]]}


def test_the_report_is_one_file_with_its_pictures(
    cleared: Any, engine: Any, runs: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    network = {"dipn": checkpoint.load_network(runs["dipn"], network="dipn")}
    values, films = push_errors.evaluate(
        network, engine, CONFIG, Partial(tmp_path, {}), scenes=2, seed=3, physics=False, segmented=False
    )
    (tmp_path / "p").mkdir()
    np.savez_compressed(tmp_path / "p" / "films.npz", **films)  # type: ignore[arg-type]
    metrics.write(tmp_path / "p", values, settings={})
    sources = page.Sources(prediction=tmp_path / "p", clears=[cleared[1]], runs=list(runs.values()))
    merged = page.write(tmp_path, sources)
    written = (tmp_path / "report.html").read_text()
    assert written.count("data:image/png;base64,") == 5
    assert "74.4" in written, "the paper's numbers stand beside"
    assert 'src="http' not in written and "href=" not in written
    assert merged["clear/hard/dipn+gn/completion"] == metrics.read(cleared[1])["completion"]
    assert (
        json.loads((tmp_path / "metrics.json").read_text())["push_error/dipn/5cm/all"]
        == values["push_error/dipn/5cm/all"]
    )
