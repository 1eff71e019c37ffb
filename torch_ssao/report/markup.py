"""Pieces of the page: tables, embedded pictures."""

from __future__ import annotations

import base64
from collections.abc import Collection, Mapping, Sequence
from html import escape


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    best: Collection[int] = (),
    text_columns: Collection[int] = (),
) -> str:
    """A table that scrolls on its own where it is too wide; every cell is escaped.

    Args:
        head: titles of the columns; none without a head.
        rows: cells.
        best: rows to set off. text_columns: columns of prose.
    """
    lines = []
    for index, row in enumerate(rows):
        cells = "".join(
            f"<td{' class=text' if i in text_columns else ''}>{escape(cell)}</td>" for i, cell in enumerate(row)
        )
        lines.append(f"<tr{' class=best' if index in best else ''}>{cells}</tr>")
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    top = f"<thead><tr>{titles}</tr></thead>" if head else ""
    return f'<div class="scroll"><table>{top}<tbody>{"".join(lines)}</tbody></table></div>'


def picture(pictures: Mapping[str, bytes], name: str, caption: str) -> str:
    """A picture as a data URI, with the id "picture-" and its name without ".png"; nothing where it is missing."""
    if name not in pictures:
        return ""
    data = base64.b64encode(pictures[name]).decode("ascii")
    text, key = escape(caption, quote=True), escape(f"picture-{name.removesuffix('.png')}", quote=True)
    return f'<figure><img id="{key}" alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'


def plot(pictures: Mapping[str, bytes], name: str, caption: str) -> str:
    """A picture no wider than a column of text."""
    return f'<div class="plot">{picture(pictures, name, caption)}</div>' if name in pictures else ""
