"""One page of a run and its estimate: tracks, errors, consistency, ranging, health, numbers.

``gather`` collects the content, ``write`` draws and writes it. The page is one HTML file
that needs nothing else; the figures go beside it as SVG and PNG where that is wanted.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from relpos.errors import RelposError
from relpos.evaluation.report.content import Baseline, Content, gather, reckon
from relpos.evaluation.report.drawing import Picture, inline, save, svg
from relpos.evaluation.report.page import page
from relpos.evaluation.report.pictures import PICTURES, pictures
from relpos.extras import require
from relpos.files import write_output

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write(content: Content, path: Path | str, figures: Path | str | None = None) -> Path:
    """Write the page of a run; the figures also as SVG and PNG into a folder. Return its path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_output(path, page(content, _drawn(content, figures)))
    return path


def write_figures(content: Content, figures: Path | str) -> None:
    """Write the figures of a run's page as SVG and PNG into a folder."""
    _drawn(content, figures)


def _drawn(content: Content, figures: Path | str | None) -> dict[str, tuple[Picture, str]]:
    require("report")
    if figures is not None:
        Path(figures).mkdir(parents=True, exist_ok=True)
    drawn: dict[str, tuple[Picture, str]] = {}
    for picture in pictures(content):
        figure = picture.figure()
        document = svg(figure)
        if figures is not None:
            save(figure, document, Path(figures), picture.name)
        drawn[picture.name] = (
            picture,
            inline(document, picture.name, picture.title, picture.alt),
        )
    return drawn


def draw(content: Content, name: str) -> Figure:
    """Draw one of the page's figures; RelposError where there is none of that name, or nothing."""
    require("report")
    if name not in PICTURES:
        raise RelposError(f"no figure '{name}': one of {', '.join(PICTURES)}")
    picture = PICTURES[name](content)
    if picture is None:
        raise RelposError(f"{content.run.name}: nothing to draw for the figure '{name}'")
    return picture.figure()


__all__ = [
    "PICTURES",
    "Baseline",
    "Content",
    "Picture",
    "draw",
    "gather",
    "pictures",
    "reckon",
    "write",
    "write_figures",
]
