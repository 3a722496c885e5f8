"""The comparison's page, and the README, show the figures in docs."""

import importlib.util
import json
import pathlib

DOCS = pathlib.Path(__file__).parents[3] / "docs"


def test_the_page_in_docs_shows_the_figures_in_docs() -> None:
    place = importlib.util.spec_from_file_location("clearing_page", DOCS / "clearing.py")
    assert place is not None and place.loader is not None
    page = importlib.util.module_from_spec(place)
    place.loader.exec_module(page)
    texts = [path.read_text() for path in (DOCS / "clearing.md", DOCS.parent / "README.md")]
    for table in page.tables(json.loads((DOCS / "clearing.json").read_text())):
        assert all(table in text for text in texts)
    assert page.swept(json.loads((DOCS / "sweep.json").read_text())) in texts[0]
