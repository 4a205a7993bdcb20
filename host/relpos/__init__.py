"""Where everybody is, relative to each other: cooperative positioning from IMU and UWB.

The names below are loaded when they are first used, so that ``import relpos`` costs nothing:
See :mod:`relpos.api`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from relpos.version import __version__

if TYPE_CHECKING:
    from relpos.api import bound, evaluate, fuse, load, plot, report, save, simulate
    from relpos.errors import DataError, DeviceError, RelposError
    from relpos.evaluation.result import Result
    from relpos.evaluation.scoring import Evaluation
    from relpos.fusion.estimator import (
        Alternative,
        Estimate,
        Estimator,
        NodeEstimate,
        NodeStatus,
        PairEstimate,
        Parameter,
        pairs_of,
    )
    from relpos.measurements import Heading, Height, Measurement, Motion, Prior, Range, Truth
    from relpos.runs import Run

_LAZY = {
    "relpos.api": ("bound", "evaluate", "fuse", "load", "plot", "report", "save", "simulate"),
    "relpos.errors": ("DataError", "DeviceError", "RelposError"),
    "relpos.evaluation.result": ("Result",),
    "relpos.evaluation.scoring": ("Evaluation",),
    "relpos.fusion.estimator": (
        "Alternative",
        "Estimate",
        "Estimator",
        "NodeEstimate",
        "NodeStatus",
        "PairEstimate",
        "Parameter",
        "pairs_of",
    ),
    "relpos.measurements": (
        "Heading",
        "Height",
        "Measurement",
        "Motion",
        "Prior",
        "Range",
        "Truth",
    ),
    "relpos.runs": ("Run",),
}
_WHERE = {name: module for module, names in _LAZY.items() for name in names}

__all__ = [
    "Alternative",
    "DataError",
    "DeviceError",
    "Estimate",
    "Estimator",
    "Evaluation",
    "Heading",
    "Height",
    "Measurement",
    "Motion",
    "NodeEstimate",
    "NodeStatus",
    "PairEstimate",
    "Parameter",
    "Prior",
    "Range",
    "RelposError",
    "Result",
    "Run",
    "Truth",
    "__version__",
    "bound",
    "evaluate",
    "fuse",
    "load",
    "pairs_of",
    "plot",
    "report",
    "save",
    "simulate",
]


def __getattr__(name: str) -> Any:
    """Load a name of the interface when it is first used."""
    if name not in _WHERE:
        raise AttributeError(f"module 'relpos' has no attribute '{name}'")
    value = getattr(import_module(_WHERE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List what there is, loaded or not."""
    return sorted({*globals(), *_WHERE})
