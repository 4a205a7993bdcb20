"""The figures of a report by name, in the order of the page.

Each function returns a :class:`Picture`, or None where the run has no data for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from relpos.evaluation.report.accuracy_figures import distances, error_distribution, error_over_time
from relpos.evaluation.report.consistency_figures import consistency, status
from relpos.evaluation.report.content import Content
from relpos.evaluation.report.drawing import Picture
from relpos.evaluation.report.map_figures import heights, section, tracks
from relpos.evaluation.report.node_figures import health, parameters
from relpos.evaluation.report.ranging_figures import detection, residuals

PICTURES: Mapping[str, Callable[[Content], Picture | None]] = {
    "tracks": tracks,
    "error": error_over_time,
    "error-distribution": error_distribution,
    "distances": distances,
    "consistency": consistency,
    "status": status,
    "detection": detection,
    "residuals": residuals,
    "parameters": parameters,
    "section": section,
    "height": heights,
    "health": health,
}
"""Name -> what draws it, in the order of the page."""


def pictures(content: Content) -> list[Picture]:
    """Return every figure that this run has something for."""
    made = (draw(content) for draw in PICTURES.values())
    return [picture for picture in made if picture is not None]
