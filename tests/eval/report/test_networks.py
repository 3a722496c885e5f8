import pathlib
import re

import pytest
from dipn_jax.eval.report import networks, page

from dipn_jax.errors import UserError
from dipn_jax.system import files

DIGEST = "0123456789abcdef" * 4


def _cells(table: str) -> list[list[str]]:
    return [re.findall(r"<td>(.*?)</td>", row) for row in table.split("<tr>")[2:]]


def test_every_network_is_named_with_its_step_and_digest(tmp_path: pathlib.Path) -> None:
    new, old, none = tmp_path / "new", tmp_path / "old", tmp_path / "none"
    used = {"step": 1500, "digest": DIGEST}
    found = {"/runs/dipn": used, "/runs/gn/checkpoints/00001500": used, "/runs/vpg": None}
    files.write_json(new / "settings.json", {"method": "dipn+gn", "label": "<more>", "networks": found})
    files.write_json(old / "settings.json", {"method": "gn", "label": ""})
    assert _cells(networks.table({new: "clear", old: "clear", none: "prediction"})) == [
        ["dipn+gn", "&lt;more&gt;", "dipn", "1500", "0123456789ab"],
        ["dipn+gn", "&lt;more&gt;", "gn", "1500", "0123456789ab"],
        ["dipn+gn", "&lt;more&gt;", "vpg", "-", "-"],
        ["gn", "-", "-", "-", "-"],
        ["prediction", "-", "-", "-", "-"],
    ]
    assert page._evaluated(page.Sources(clears=[new, old], prediction=none)) == {
        new: "clear", old: "clear", none: "prediction",
    }  # fmt: skip
    files.write_json(new / "settings.json", {"networks": {"/runs/dipn": {"step": -1, "digest": DIGEST}}})
    with pytest.raises(UserError, match=r"settings.json: damaged"):
        networks.table({new: "clear"})
