"""Where everybody is, relative to each other: cooperative positioning from IMU and UWB."""

__version__ = "0.1.0"
