"""A node's sensor calibration in SI units, and its words on the wire."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from relpos.errors import DataError
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.protocol.schema import OutOfRangeError

FloatArray = NDArray[np.float64]


def _zeros() -> FloatArray:
    return np.zeros(3)


@dataclass(frozen=True)
class SensorCalibration:
    """The corrections that the firmware applies to every sample; the default changes nothing.

    In the axes of accelerometer and gyroscope: specific force (3,) := (force - bias) (1 + scale),
    rate (3,) := rate - bias, field (3,) := field_matrix (field - offset). ``gyro_bias_sigma_rad_s``
    is the standard deviation of the bias in use; 0 means never calibrated.
    """

    acceleration_bias_m_s2: FloatArray = field(default_factory=_zeros)
    acceleration_scale: FloatArray = field(default_factory=_zeros)
    gyro_bias_rad_s: FloatArray = field(default_factory=_zeros)
    gyro_bias_sigma_rad_s: float = 0.0
    field_offset_ut: FloatArray = field(default_factory=_zeros)
    field_matrix: FloatArray = field(default_factory=lambda: np.eye(3))

    def correct_acceleration(self, force_m_s2: FloatArray) -> FloatArray:
        """Return the corrected specific force of samples (n, 3)."""
        corrected: FloatArray = (force_m_s2 - self.acceleration_bias_m_s2) * (
            1.0 + self.acceleration_scale
        )
        return corrected

    def to_words(self) -> list[int]:
        """Return the 16-bit words that the node stores; DataError where one does not fit."""
        values = [
            *self.acceleration_bias_m_s2,
            *self.gyro_bias_rad_s,
            *self.acceleration_scale,
            *self.field_offset_ut,
            *(self.field_matrix - np.eye(3)).ravel(),
            self.gyro_bias_sigma_rad_s,
        ]
        try:
            return [
                word.to_raw(float(value))
                for word, value in zip(wire.CALIBRATION, values, strict=True)
            ]
        except OutOfRangeError as error:
            raise DataError(
                f"the calibration does not fit a node ({error}): the sensor is broken, or the "
                "calibration was not carried out as described"
            ) from error

    @staticmethod
    def from_words(words: Sequence[int]) -> SensorCalibration:
        """Inverse of :meth:`to_words`, exact."""
        values = np.array(
            [word / field.per_unit for word, field in zip(words, wire.CALIBRATION, strict=True)]
        )
        return SensorCalibration(
            acceleration_bias_m_s2=values[0:3],
            gyro_bias_rad_s=values[3:6],
            acceleration_scale=values[6:9],
            field_offset_ut=values[9:12],
            field_matrix=np.eye(3) + values[12:21].reshape(3, 3),
            gyro_bias_sigma_rad_s=float(values[21]),
        )


def checksum(words: Sequence[int]) -> int:
    """Return the checksum with which COMMIT_CALIBRATION puts these words into force."""
    return framing.crc16(struct.pack(f"<{len(words)}h", *words))
