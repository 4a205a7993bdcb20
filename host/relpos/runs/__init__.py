"""Run directories: the CSV tables of a recording, and of the estimates that are made of it.

A run directory holds ``run.toml`` and one table a kind of measurement (docs/run-format.md);
:func:`load_run` reads it strictly and names file, line and column of a fault. A :class:`Run` keeps
the measurements, which an estimator may see, apart from the truth. :class:`RunFiles` and
:class:`EstimateFiles` write while a session runs, and survive a full disk. Everything that records,
simulates, estimates or scores exchanges this package's classes; begin reading with
:mod:`relpos.runs.run`.
"""

from relpos.runs.description import Description, InitialPose, NodeInfo, Simulated
from relpos.runs.estimates import (
    EstimateFiles,
    drop_page,
    read_estimates,
    read_initial,
    write_estimates,
)
from relpos.runs.imu import ImuRecording
from relpos.runs.landmarks import Landmark
from relpos.runs.run import Run, RunFiles, load_run, save_run

__all__ = [
    "Description",
    "EstimateFiles",
    "ImuRecording",
    "InitialPose",
    "Landmark",
    "NodeInfo",
    "Run",
    "RunFiles",
    "Simulated",
    "drop_page",
    "load_run",
    "read_estimates",
    "read_initial",
    "save_run",
    "write_estimates",
]
