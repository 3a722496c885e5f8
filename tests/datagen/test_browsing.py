"""The page of a data set."""

import base64
import html.parser
import pathlib
import re
import shutil
import subprocess

import cv2
import numpy as np
import pytest
from dipn_jax.datagen import cli

from dipn_jax.commands import console
from dipn_jax.sight import render
from dipn_jax.storage import records
from dipn_jax.structs import Fault
from dipn_jax.system import files
from dipn_jax.world import shapes

Data = dict[str, pathlib.Path]
NASTY = "\"'><script>alert(1)</script> <img src=x> {a}"
"""What a user may call a folder, and a seed that is none."""


class Page(html.parser.HTMLParser):
    """What stands on a page: tags with their attributes, and text."""

    def __init__(self, path: pathlib.Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def info(*words: object) -> int:
    return console.run("dipn-datagen", cli.COMMANDS, ["info", *map(str, words)])


def test_pushes_can_be_sifted_by_what_they_are(data: Data, tmp_path: pathlib.Path) -> None:
    assert info(data["push"], "--html", tmp_path / "p.html", "--sample", 10, "--seed", 3) == 0
    page, pushes = Page(tmp_path / "p.html"), records.load(data["push"], kind="push")[0]
    figures, captions = page.all("figure"), re.findall(r"(\d+): none|(\d+): \w", page.text)
    assert len(figures) == len(captions) == 10 and len(page.all("img")) == 20 and len(page.all("svg")) == 10
    numbers = [int(a or b) for a, b in captions]
    assert numbers == sorted(np.random.default_rng(3).choice(24, 10, replace=False))
    for number, one in zip(numbers, figures, strict=True):
        names = [name for bit, name in Fault.NAMES.items() if pushes.fault[number] & bit]
        assert one["data-fault"] == " ".join(names or ["none"]) and one["data-distance"] == "10cm"
        assert set(str(one["data-shape"]).split()) == {shapes.CLASSES[i] for i in pushes.scene.shape[number]}
        apart = np.linalg.norm(pushes.after[number, :, :3] - pushes.poses[number, 0, :, :3], axis=-1)
        assert one["data-outcome"] == f"{(apart > 0.001).sum()}-moved"
    content = base64.b64decode(str(page.all("img")[1]["src"]).partition(",")[2])
    after = render.observe(pushes.scene[numbers[:1]], pushes.after[numbers[:1]]).color[0]
    shown = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_allclose(shown / 255, np.asarray(after)[::-2, ::2], atol=0.51 / 255)
    assert [one["name"] for one in page.all("select")] == ["fault", "distance", "outcome", "shape"]


def test_counts_are_of_all_episodes(data: Data, tmp_path: pathlib.Path) -> None:
    assert info(data["grasp"], "--html", tmp_path / "g.html", "--sample", 1) == 0
    text, grasps = (tmp_path / "g.html").read_text(), records.load(data["grasp"], kind="grasp")[0]
    held = grasps.held.sum(-1)
    for number in np.unique(held):
        assert f"<td>{number}-held</td><td>{(held == number).sum()}</td>" in text
    longest = 100 * grasps.scene.size.max(-1)
    for low in np.unique(np.floor(longest)).astype(int):
        assert f"<td>{low:3d} to {low + 1} cm</td><td>{(np.floor(longest) == low).sum()}</td>" in text
    assert "<td>  3</td><td>24</td>" in text, "objects on the table"


def test_the_page_stands_alone_and_names_are_text(data: Data, tmp_path: pathlib.Path) -> None:
    folder = pathlib.Path(shutil.copytree(data["images"], tmp_path / NASTY.replace("/", "-")))
    files.write_json(folder / "asked.json", {"command": ["images", NASTY], "of": 1})
    assert info(folder, "--html", tmp_path / "deep" / "i.html") == 0
    page = Page(tmp_path / "deep" / "i.html")
    assert len(page.all("script")) == 1 and len(page.all("img")) == 4, "none of them comes from a name"
    assert all(str(one["src"]).startswith("data:image/png;base64,") for one in page.all("img"))
    assert not page.all("link") and all("src" not in one for one in page.all("script"))
    assert "default-src 'none'" in str(page.all("meta")[1]["content"])
    assert NASTY in page.text and "4 images episodes" in page.text


def test_what_cannot_be_shown_is_one_line(
    data: Data, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shard = data["push"] / "shard-00000.parquet"
    before = shard.read_bytes()
    for says, words in (
        ("want a file whose name ends in .html", (tmp_path, "--html", shard)),
        (f"no file can be written in {shard}", (tmp_path, "--html", shard / "p.html")),
        ("--sample 0", (data["push"], "--html", tmp_path / "p.html", "--sample", 0)),
        ("a folder; give the name of a file", (data["push"], "--html", tmp_path)),
        ("no manifest.json", (tmp_path, "--html", tmp_path / "p.html")),
    ):
        assert info(*words) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1 and says in error
    assert list(tmp_path.iterdir()) == [] and shard.read_bytes() == before


def test_a_browser_sifts(data: Data, tmp_path: pathlib.Path) -> None:
    """Choose in a real browser what no episode has, and what all have."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("no Chromium here")
    path = tmp_path / "p.html"
    assert info(data["push"], "--html", path, "--sample", 6) == 0
    chosen = {"no-such": 0, "10cm": 6}
    for value, wanted in chosen.items():
        script = (
            f"const s=document.querySelector('select[name=distance]');s.add(new Option('{value}'));"
            f"s.value='{value}';s.dispatchEvent(new Event('change'))"
        )
        page = tmp_path / f"{value}.html"
        page.write_text(path.read_text().replace("</html>", f"<script>{script}</script></html>"))
        words = ["--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", page.as_uri()]
        shown = subprocess.run([browser, *words], capture_output=True, text=True, check=True, timeout=60).stdout
        assert f'<span id="shown">{wanted}</span>' in shown
        assert shown.count('hidden=""') == 6 - wanted
