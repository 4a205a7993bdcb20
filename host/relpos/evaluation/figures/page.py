"""One page with all figures, that needs no other file."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

from relpos.evaluation.figures.sheet import Beside, Cell, Sheet
from relpos.files import write_output

MOST_ROWS = 120
"""Longer lists of numbers are in the CSV alone."""

_CSS = """
body{font:16px/1.5 system-ui,sans-serif;color:#222;max-width:72rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem}
h2{font-size:1.2rem;margin-top:3rem;border-top:1px solid #ddd;padding-top:1.5rem}
img{max-width:100%;height:auto}table{border-collapse:collapse;margin:.6rem 0;font-size:.92rem}
td,th{padding:.15rem .8rem;border-bottom:1px solid #ddd;text-align:right}
td:first-child,th:first-child{text-align:left}p.caption{max-width:52rem}
summary{cursor:pointer;color:#0072B2}
"""


def write(sheets: Sequence[Sheet], pictures: Sequence[Path], path: Path, words: str) -> None:
    """Write the page; ``pictures`` are the sheets' SVG files, ``words`` say how it was made."""
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width,initial-scale=1'>",
        f"<title>The paper's figures</title><style>{_CSS}</style>",
        "<h1>Every figure and table of the paper's sections V and VI, computed anew</h1>",
        f"<p class=caption>{escape(words)}</p>",
    ]
    for sheet, picture in zip(sheets, pictures, strict=True):
        data = base64.b64encode(picture.read_bytes()).decode()
        parts += [
            f"<h2 id={sheet.name}>{escape(sheet.title)}</h2>",
            f"<img alt='{escape(sheet.title, quote=True)}' src='data:image/svg+xml;base64,{data}'>",
            f"<p class=caption>{escape(sheet.caption)}</p>",
        ]
        if sheet.beside:
            parts.append(_table(("", "paper", "ours"), [_beside(b) for b in sheet.beside]))
        if len(sheet.rows) <= MOST_ROWS:
            numbers = _table(sheet.columns, [[_text(c) for c in row] for row in sheet.rows])
            parts.append(f"<details><summary>the numbers</summary>{numbers}</details>")
        parts.append(f"<p>Numbers: <code>{sheet.name}.csv</code></p>")
    write_output(path, "\n".join(parts) + "</html>\n")


def _beside(one: Beside) -> tuple[str, str, str]:
    ours = f"{one.ours:.3g}" if one.unit != "m" else f"{one.ours:.2f}"
    if math.isfinite(one.half_width):
        ours += f" ± {one.half_width:.2f}"
    return one.what, f"{one.paper} {one.unit}" if one.paper != "-" else "-", f"{ours} {one.unit}"


def _text(cell: Cell) -> str:
    if isinstance(cell, float):
        return f"{cell:.4g}" if math.isfinite(cell) else "-"
    return str(cell)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(c)}</th>" for c in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"
