"""Run directories: how a recording comes in and an estimate goes out."""

from relpos.runs.description import Description, InitialPose, NodeInfo, Simulated
from relpos.runs.estimates import (
    EstimateFiles,
    read_estimates,
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
    "load_run",
    "read_estimates",
    "save_run",
    "write_estimates",
]
