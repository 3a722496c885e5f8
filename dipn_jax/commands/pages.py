"""Parts of HTML pages that stand alone: text that is escaped, tables, bars, and the frame around them."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence

STYLE = """body{font:16px/1.5 system-ui,sans-serif;max-width:1000px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:1em 0}td,th{padding:.25em .8em;border-bottom:1px solid #ddd;text-align:right}
td:first-child,th:first-child{text-align:left}img{max-width:100%}h2{margin-top:2em}.note{color:#666}"""
"""How every page looks."""
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


def escaped(text: str) -> str:
    """Return a user's text escaped for HTML, `{` included, because `{` marks the places of figures."""
    readable = text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    return html.escape(readable).replace("{", "&#123;")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return an HTML table of plain text."""

    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{escaped(cell)}</{tag}>" for cell in cells) + "</tr>"

    return f"<table>{line(head, 'th')}{''.join(line(row, 'td') for row in rows)}</table>"


def bars(title: str, counts: Mapping[str, int]) -> str:
    """Return a table of counts with a bar beside each."""
    most = max([1, *counts.values()])
    rows = "".join(
        f"<tr><td>{escaped(name)}</td><td>{count}</td>"
        f'<td class="bar"><i style="width:{100 * count / most:.1f}%"></i></td></tr>'
        for name, count in counts.items()
    )
    return f"<section><h3>{escaped(title)}</h3><table>{rows}</table></section>"


def picture(png: bytes, alt: str) -> str:
    """Return a PNG as an HTML image with its bytes inside the page."""
    return f'<img alt="{escaped(alt)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def standalone_page(title: str, body: str, *, style: str = "", script: str = "") -> str:
    """Return a page that loads nothing from elsewhere.

    Args:
      title: plain text.
      body: HTML.
      style: CSS beside STYLE.
      script: JavaScript that runs when the page is there; what nobody else wrote.
    """
    run = f"<script>{script}</script>" if script else ""
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" '
        f'content="{_POLICY}"><title>{escaped(title)}</title><style>{STYLE}{style}</style>{body}{run}</html>\n'
    )
