"""Calibration of a node's sensors, of its wearer's steps and of two nodes' antennas.

Pure functions: arrays in, fits out, no port and no file; ``relpos node calibrate`` guides through
the steps and ``relpos.link.dialogue`` moves samples and results. ``inertial`` fits gyroscope bias
and accelerometer (Frosio, Pedersini and Borghese 2009), ``magnetometer`` hard and soft iron,
``steps`` the step gain from a walk of known length, ``antenna`` the range offset
(Decawave APS014). ``guide`` measures a calibration's progress and joins the fits.
``sensors.SensorCalibration`` is the result that a node stores. Begin with ``guide``.
"""

from relpos.calibration.sensors import SensorCalibration

__all__ = ["SensorCalibration"]
