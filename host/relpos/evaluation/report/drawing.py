"""Drawing: a figure as SVG for a page, and as files."""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from relpos.evaluation.style import DARK, STYLE
from relpos.files import open_output, write_output
from relpos.tracks import MAX_GAP_S, Tracks, interpolate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = npt.NDArray[np.float64]

MOST_PANELS = 15
"""All pairs of six nodes; more would be too small to read."""

MANY_DOTS = 3000
"""More dots than this become pixels: a page of a long session stays a few megabytes."""

MANY_POINTS = 100_000
"""Lines of a figure that have more points together than this become pixels, too."""


@dataclass(frozen=True)
class Picture:
    """One figure: its name, texts and size, and the function that draws it."""

    name: str
    title: str
    caption: str
    alt: str
    draw: Callable[[Figure], None]
    size_in: tuple[float, float]

    def figure(self) -> Figure:
        """Draw it."""
        from matplotlib.figure import Figure

        # The Figure class alone, without pyplot: no display, no global state.
        with _styled():
            made = Figure(figsize=self.size_in, layout="constrained")
            self.draw(made)
        curves = [curve for axes in made.axes for curve in (*axes.lines, *axes.collections)]
        if sum(map(_points, curves)) > MANY_POINTS:
            for curve in curves:
                curve.set_rasterized(_points(curve) > MANY_POINTS // 1000)
        return made


def _points(curve: Any) -> int:
    paths = curve.get_paths() if hasattr(curve, "get_paths") else (curve.get_path(),)
    return sum(len(path.vertices) for path in paths)


@contextmanager
def _styled() -> Iterator[None]:
    """Draw in the project's style; letters that its font lacks are the browser's in an SVG."""
    import matplotlib as mpl

    with mpl.rc_context(STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        yield


def svg(figure: Figure) -> str:
    """Return a figure as an SVG document; the same figure is the same text."""
    written = io.StringIO()
    with _styled():
        # Laid out once, and not again by each way of saving it.
        if (engine := figure.get_layout_engine()) is not None:
            engine.execute(figure)
            figure.set_layout_engine(None)
        figure.savefig(written, format="svg", metadata={"Date": None, "Creator": None})
    return _numbered(_shorter(written.getvalue()))


def save(figure: Figure, document: str, directory: Path, name: str) -> list[Path]:
    """Write NAME.svg and NAME.png; return their paths."""
    paths = [directory / f"{name}.svg", directory / f"{name}.png"]
    write_output(paths[0], document)
    with _styled(), open_output(paths[1]) as file:
        # Without a date in it the same report is the same file.
        figure.savefig(file, format="png", dpi=130, metadata={"Software": None})
    return paths


def inline(document: str, name: str, title: str, alt: str) -> str:
    """Make an SVG document part of a page: its own ids, the page's colours, a title and a text.

    Nothing in it refers to anything outside of the page.
    """
    text = document[document.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<style type=\"text/css\">.*?</style>", "", text, flags=re.DOTALL)
    box = re.search(r'viewBox="([^"]+)"', text)
    assert box is not None
    text = text[text.index(">") + 1 :]
    text = text.replace("xlink:href=", "href=")
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = text.replace('href="#', f'href="#{name}-').replace("url(#", f"url(#{name}-")
    text = re.sub(r"#[0-9a-f]{6}\b", lambda m: _VARIABLES.get(m[0].lower(), m[0]), text)
    head = (
        f'<svg viewBox="{box[1]}" role="img" aria-labelledby="{name}-title {name}-alt">'
        f'<title id="{name}-title">{escape(title)}</title>'
        f'<desc id="{name}-alt">{escape(alt)}</desc>'
    )
    return head + text.strip()


def _variable(colour: str) -> str:
    return f"--c{colour.lower().lstrip('#')}"


_VARIABLES = {c.lower(): f"var({_variable(c)},{c.lower()})" for c in DARK}


def colours() -> tuple[str, str]:
    """Return the style sheet's declarations of the figures' colours, for light and for dark."""
    light = "".join(f"{_variable(c)}:{c.lower()};" for c in DARK)
    return light, "".join(f"{_variable(c)}:{d.lower()};" for c, d in DARK.items())


def _numbered(document: str) -> str:
    """Number what Matplotlib names by hashes, some of them of addresses in memory."""
    names: dict[str, str] = {}
    for name in re.findall(r'\bid="([a-z][0-9a-f]{10})"', document):
        names.setdefault(name, f"{name[0]}{len(names)}")
    return re.sub(
        r'(id="|url\(#|href="#)([a-z][0-9a-f]{10})\b',
        lambda m: m[1] + names.get(m[2], m[2]),
        document,
    )


def _shorter(document: str) -> str:
    """Hundredths of a point are finer than any screen."""
    return re.sub(
        r' (d|x|y|transform|points)="([^"]*)"',
        lambda m: f' {m[1]}="' + re.sub(r"(\d\.\d{2})\d+", r"\1", m[2]) + '"',
        document,
    )


def broken_at_gaps(time_s: Floats, *values: Floats) -> tuple[Floats, ...]:
    """Insert NaN where rows are too far apart to be joined by a line.

    Returns the time and the one signal, or only the signals where there are two of them (a
    track's x and y).
    """
    order = np.argsort(time_s, kind="stable")
    after = np.flatnonzero(np.diff(time_s[order]) > MAX_GAP_S + 1e-6) + 1
    broken = tuple(np.insert(v[order].astype(float), after, np.nan) for v in (time_s, *values))
    return broken if len(values) == 1 else broken[1:]


def dots(axes: Axes, x: Floats, y: Floats, colour: str, **more: Any) -> None:
    """Draw dots; many of them as pixels."""
    given: dict[str, Any] = {"markersize": 3.0, "alpha": 0.7, "zorder": 1.5, **more}
    axes.plot(x, y, ".", color=colour, markeredgewidth=0.0, rasterized=x.size > MANY_DOTS, **given)


def grid(figure: Figure, count: int, columns: int) -> Sequence[Axes]:
    """Return ``count`` panels in rows of at most ``columns``, those of a column with one time axis.

    The labels of the time axis stand under the lowest panel of each column.
    """
    columns = min(columns, max(count, 1))
    rows = max(1, -(-count // columns))
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for k, axes in enumerate(panels):
        axes.set_visible(k < count)
        if k + columns >= count:
            axes.set_xlabel("time (s)")
            axes.xaxis.set_tick_params(labelbottom=True)
    return list(panels[:count])


def flat_distance(tracks: Tracks, pair: tuple[int, int], at_s: Floats) -> Floats:
    """Return the horizontal distance of a pair at given times (n,), NaN where not known."""
    if pair[0] not in tracks or pair[1] not in tracks:
        return np.full(at_s.shape, np.nan)
    a, b = (tracks[node] for node in pair)
    dx = interpolate(a.time_s, a.x_m, at_s) - interpolate(b.time_s, b.x_m, at_s)
    dy = interpolate(a.time_s, a.y_m, at_s) - interpolate(b.time_s, b.y_m, at_s)
    result: Floats = np.hypot(dx, dy)
    return result


def logarithmic(axes: Axes, bottom: float) -> None:
    """Make the y axis logarithmic from ``bottom`` on, with plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_yscale("log")
    axes.set_ylim(bottom=bottom)
    decades = math.log10(axes.get_ylim()[1] / bottom)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 3.0 else (1.0,)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
