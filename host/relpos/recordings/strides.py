"""Strides of a foot-worn sensor, for which the foot stands still at mid-stance.

The mean angular rate is least there; between two of these instants the acceleration without gravity
is integrated twice, and the speed that is left over is taken out evenly.
"""

from __future__ import annotations

import numpy as np
import scipy

from relpos.recordings.tables import Array

RATE_HZ = 100.0
# A stance: less than this, or than a quarter of the trial's mean (a fast foot is never so still).
STILL_RAD_S, STILL_SHARE = 0.6, 0.25
APART = 15  # samples: a shorter interruption of a stance is none


def stances(rate_rad_s: Array) -> list[tuple[int, int, int]]:
    """Begin, stillest sample and end of each stance, of angular rates (n, 3)."""
    speed = np.linalg.norm(rate_rad_s, axis=1)
    average = scipy.ndimage.uniform_filter1d
    smooth = average(average(speed, 5), 9)
    still = np.flatnonzero(smooth < max(STILL_RAD_S, STILL_SHARE * float(speed.mean())))
    parts = np.split(still, np.flatnonzero(np.diff(still) > APART) + 1)
    return [
        (int(s[0]), int(s[0] + smooth[s[0] : s[-1] + 1].argmin()), int(s[-1]))
        for s in parts
        if len(s)
    ]


def way_m(acceleration_m_s2: Array) -> float:
    """Horizontal way during accelerations (n, 2) that begin and end at rest."""
    mean = (acceleration_m_s2[1:] + acceleration_m_s2[:-1]) / 2
    velocity = np.vstack([[0.0, 0.0], np.cumsum(mean, axis=0) / RATE_HZ])
    velocity -= np.linspace(0.0, 1.0, len(velocity))[:, None] * velocity[-1]
    return float(np.hypot(*velocity.sum(axis=0)) / RATE_HZ)
