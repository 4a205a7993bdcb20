"""What a node's sensors and its wearer's steps are wrong by, found from what the node tells.

Pure: arrays in, figures out, no port and no file. :mod:`relpos.link.dialogue` fetches the samples
and sends the result, ``relpos node calibrate`` guides through it.
"""

from relpos.calibration.sensors import SensorCalibration

__all__ = ["SensorCalibration"]
