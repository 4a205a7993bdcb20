"""The page: one self-contained HTML file."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from html import escape

from relpos.evaluation.iso18305 import Frame
from relpos.evaluation.report import tables
from relpos.evaluation.report.content import Content
from relpos.evaluation.report.drawing import Picture, colours
from relpos.evaluation.report.tables import Table
from relpos.files import displayable
from relpos.version import __version__

Tables = tuple[Callable[[Content], Table | None], ...]

SECTIONS: Sequence[tuple[str, str, tuple[str, ...], Tables]] = (
    ("where", "Positions", ("tracks",), (tables.located,)),
    (
        "accuracy",
        "Accuracy",
        ("error", "error-distribution"),
        (tables.main_figures, tables.iso, tables.latency, tables.nodes, tables.pairs),
    ),
    ("distances", "Distances", ("distances",), ()),
    ("consistency", "Consistency", ("consistency", "status"), (tables.consistency,)),
    ("ranging", "Ranging", ("detection", "residuals"), (tables.ranges,)),
    ("learned", "Learned on the way", ("parameters",), (tables.learned,)),
    ("height", "Height", ("section", "height"), (tables.vertical,)),
    (
        "health",
        "Links and nodes",
        ("health",),
        (tables.health, tables.reasons, tables.counters),
    ),
    ("log", "Log", (), (tables.log,)),
)
"""Sections of the page: id, title, pictures, tables. Empty ones are left out."""


def page(content: Content, drawn: Mapping[str, tuple[Picture, str]]) -> str:
    """Write the page; ``drawn`` holds each picture with its inline SVG, by name."""
    sections, links = [], []
    for key, title, pictures, made in SECTIONS:
        figures = [_figure(*drawn[name]) for name in pictures if name in drawn]
        shown = [table.html() for make in made if (table := make(content)) is not None]
        # Figures that belong to numbers come after them, a map before its table.
        parts = figures + shown if key != "accuracy" else [*shown[:1], *figures, *shown[1:]]
        if parts:
            sections.append(
                f'<section id="{key}"><h2>{escape(title)}</h2>\n' + "\n".join(parts) + "</section>"
            )
            links.append(f'<li><a href="#{key}">{escape(title)}</a></li>')
    light, dark = colours()
    numbers = json.dumps(content.as_json(), allow_nan=False).replace("</", "<\\/")
    document = _PAGE.format(
        title=escape(content.run.name),
        style=_CSS.replace("LIGHT", light).replace("DARK", dark),
        subtitle=_subtitle(content),
        tiles=_tiles(content),
        words="\n".join(f"<p>{escape(words)}</p>" for words in _in_short(content)),
        links="".join(links),
        sections="\n".join(sections),
        facts=_facts(content),
        numbers=numbers,
        version=__version__,
    )
    # A run has the name of its folder, which need not be UTF-8.
    return displayable(document)


def _figure(picture: Picture, svg: str) -> str:
    width = "narrow" if picture.size_in[0] < 8.0 else "full"
    return (
        f'<figure class="{width}" id="figure-{picture.name}">'
        f'<div class="wide">{svg}</div>'
        f"<figcaption><b>{escape(picture.title)}.</b> {escape(picture.caption)}"
        "</figcaption></figure>"
    )


def _subtitle(content: Content) -> str:
    result, run = content.result, content.run
    parts = [f"estimator {result.estimator}" + (", smoothed" if result.smoothed else "")]
    if result.estimator_run is None:
        parts = ["an estimate that was read"]
    if result.seed is not None:
        parts.append(f"seed {result.seed}")
    parts += [f"{key} {value}" for key, value in result.settings.items()]
    if run.measurements:
        seconds = run.measurements[-1].time_s - run.measurements[0].time_s
        many = "s" * (len(content.nodes) != 1)
        parts.append(f"{len(content.nodes)} node{many} over {_duration(seconds)}")
    return escape("; ".join(parts))


def _duration(seconds: float) -> str:
    whole = round(seconds)
    hours, rest = divmod(whole, 3600)
    minutes, left = divmod(rest, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {left} s" if minutes else f"{left} s"


TILE_WORDS = {
    Frame.AS_GIVEN: "in the truth's frame: the whole team may have drifted",
    Frame.PER_RUN: "of the run, laid on the truth once",
    Frame.PER_EPOCH: "of the team's shape, each second",
}
"""What a tile says to who does not know ISO/IEC 18305."""


def _tiles(content: Content) -> str:
    """Return the tiles with the main figures."""
    tiles: list[tuple[str, str, str]] = []
    scored = content.evaluation
    if scored is not None:
        m, bound = scored.metrics, content.bound
        smoothed = content.result.smoothed
        least = None if bound is None else bound.totals().of(smoothed=smoothed)[0]
        if m.epochs:
            tiles.append(
                (
                    tables.value(m.relative_distance_rmse_m, "m"),
                    "relative distance RMSE",
                    f"bound {least:.2f} m" if least is not None else "all pairs",
                )
            )
        frames = scored.iso.frames
        for frame in dict.fromkeys((scored.iso.headline, Frame.PER_EPOCH)):
            if frame is None or frame not in frames:
                continue
            one = frames[frame]
            tiles.append(
                (
                    tables.value(one.horizontal.e95_m, "m"),
                    "95 % of errors are less (CE95)",
                    TILE_WORDS[frame],
                )
            )
        nees = scored.nees_distance
        if m.epochs and nees.values:
            tiles.append(
                (
                    tables.value(nees.mean),
                    "NEES of the distances",
                    f"honest: {nees.low:.2f} to {nees.high:.2f}",
                )
            )
    ranges = sum(one.range_m.size for one in content.ranges)
    failed = sum(one.failed for one in content.ranges)
    tiles.append(
        (tables.value(ranges, "", 0), "ranges", f"{failed} failed" if failed else "measured")
    )
    received = sum(one.received for one in content.health.values())
    lost = sum(one.frames_lost for one in content.health.values())
    if received:
        share = 100.0 * lost / (received + lost)
        tiles.append((f"{share:.1f} %", "frames lost", f"of {received + lost}"))
    return "".join(
        f"<li><strong>{number}</strong><span>{escape(what)}</span><small>{escape(more)}</small></li>"
        for number, what, more in tiles
    )


def _in_short(content: Content) -> list[str]:
    """Return sentences that explain the numbers."""
    scored, result = content.evaluation, content.result
    words = []
    if not result.estimates:
        return ["Nothing could be estimated."]
    if scored is not None and scored.metrics.epochs:
        m = scored.metrics
        sentence = (
            f"Distances between people are off by {m.relative_distance_rmse_m:.2f} m (RMS over all "
            "pairs and seconds)"
        )
        if content.baseline is not None and content.baseline.metrics is not None:
            other = content.baseline.metrics.relative_distance_rmse_m
            sentence += f"; {content.baseline.words} is off by {other:.2f} m"
        if content.bound is not None:
            totals = content.bound.totals()
            least, _ = totals.of(smoothed=result.smoothed)
            sentence += f"; the Cramer-Rao bound of the ranges that arrived is {least:.2f} m"
        words.append(sentence + ".")
        nees = scored.nees_distance
        if nees.values:
            verdict = (
                "agree with its errors"
                if nees.honest
                else "are smaller than its errors"
                if nees.mean > 1.0
                else "are larger than its errors"
            )
            words.append(
                f"The reported uncertainties of the distances {verdict}: NEES {_short(nees.mean)}, "
                f"{nees.low:.2f} to {nees.high:.2f} where honest."
            )
    elif scored is None:
        words.append(
            "The run has no truth"
            + (" at a time of which there is an estimate" if content.truth else "")
            + ": the page shows what follows from the estimate and the measurements alone."
        )
    return words


def _short(number: float) -> str:
    return f"{number:.2f}" if number < tables.HUGE else f"{number:.2g}"


def _facts(content: Content) -> str:
    run = content.run
    facts = [("run", run.name), ("source", run.description.source or "")]
    facts += [("estimator", content.result.estimator)]
    if content.baseline is not None:
        facts.append(("beside it", content.baseline.words))
    facts += [("made by", words) for words in content.words]
    facts.append(
        (
            "measurements",
            f"{len(run.motions)} motions, {len(run.ranges)} ranges, {len(run.statuses)} status "
            f"figures, {len(run.events)} events, {len(run.truth)} rows of truth",
        )
    )
    return "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts if value
    )


_CSS = """
:root{color-scheme:light dark;--paper:#fff;--ink:#222;--soft:#5c636b;--line:#ddd;--tile:#f5f6f7;
--link:#0062a0;LIGHT}
@media (prefers-color-scheme:dark){:root{--paper:#14181c;--ink:#e6e6e6;--soft:#a7aeb6;
--line:#343a41;--tile:#1e242a;--link:#7cc4f2;DARK}}
*{box-sizing:border-box}
body{font:16px/1.5 system-ui,-apple-system,"Segoe UI",sans-serif;color:var(--ink);
background:var(--paper);max-width:72rem;margin:0 auto;padding:1.5rem 1rem 4rem}
h1{font-size:1.7rem;line-height:1.2;margin:.5rem 0}
h2{font-size:1.25rem;margin:0 0 .8rem}
section{border-top:1px solid var(--line);margin-top:2rem;padding-top:1.2rem}
a{color:var(--link)}
.skip{position:absolute;left:-99rem}.skip:focus{position:static}
.sub,.note,figcaption,caption,small,footer{color:var(--soft)}
.sub{margin:.2rem 0 1rem}.note{max-width:60rem;font-size:.9rem;margin:.3rem 0 1.4rem}
ul.tiles{list-style:none;display:flex;flex-wrap:wrap;gap:.6rem;padding:0;margin:1rem 0}
.tiles li{background:var(--tile);border-radius:.4rem;padding:.6rem 1rem;min-width:8.5rem}
.tiles strong{display:block;font-size:1.35rem;line-height:1.3}
.tiles span,.tiles small{display:block;line-height:1.3}.tiles small{font-size:.8rem}
nav ul{list-style:none;padding:0;display:flex;flex-wrap:wrap;gap:.2rem 1.2rem;margin:1rem 0}
.wide{overflow-x:auto;margin:.8rem 0}
table{border-collapse:collapse;font-size:.93rem;font-variant-numeric:tabular-nums}
caption{text-align:left;padding:.2rem 0;font-weight:600}
th,td{padding:.22rem .9rem;text-align:right;border-bottom:1px solid var(--line);
vertical-align:top;white-space:nowrap}
td.words{white-space:normal;min-width:11rem;text-align:left}
thead th{border-bottom:2px solid var(--line);vertical-align:bottom}
th[scope=row]{text-align:left;font-weight:400;padding-left:0}
thead th:first-child{text-align:left;padding-left:0}
figure{margin:1.2rem 0 2rem}figure.narrow{max-width:52rem}
figure svg{width:100%;height:auto;display:block;stroke-linejoin:round;stroke-linecap:butt}
figcaption{max-width:60rem;font-size:.93rem;margin-top:.4rem}figcaption b{color:var(--ink)}
details{margin:.8rem 0}summary{cursor:pointer;color:var(--link)}
dl{display:grid;grid-template-columns:max-content 1fr;gap:.15rem 1rem;margin:0}
dt{color:var(--soft)}dd{margin:0;overflow-wrap:anywhere}
figure .wide{margin:0}
@media (max-width:45rem){figure svg{width:44rem}th,td{padding:.22rem .5rem}}
footer{font-size:.9rem;border-top:1px solid var(--line);margin-top:2rem;padding-top:1rem}
@media print{figure svg{width:100%}
:root{color-scheme:light;--paper:#fff;--ink:#000;--soft:#444;--line:#bbb;
--tile:#fff;LIGHT}body{max-width:none;padding:0;font-size:10pt}
nav,.skip{display:none}figure,.tiles li,tr{break-inside:avoid}h2{break-after:avoid}
.tiles li{border:1px solid var(--line)}.wide{overflow:visible}td,th{padding:.15rem .5rem}}
"""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title} - relpos</title>
<style>{style}</style>
</head>
<body>
<a class="skip" href="#main">To the content</a>
<header>
<h1>{title}</h1>
<p class="sub">{subtitle}</p>
</header>
<main id="main">
<ul class="tiles" aria-label="Main figures">{tiles}</ul>
{words}
<nav aria-label="Contents"><ul>{links}</ul></nav>
{sections}
<section id="about"><h2>About this page</h2>
<dl>{facts}</dl></section>
</main>
<script type="application/json" id="numbers">{numbers}</script>
<footer>relpos {version}. Metres, seconds, radians counter-clockwise; every number with all its
digits is in this file, as JSON in its last element.</footer>
</body>
</html>
"""
