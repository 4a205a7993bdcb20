"""Strapdown integration of a simulated walker's sensors, beside the simulation's own path."""

from __future__ import annotations

import math

import numpy as np

from relpos.simulation.walker import WalkerTruth
from relpos.simulation.world import GRAVITY_M_S2, FloatArray


def to_quaternion(matrix: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(
        np.array(
            [
                [
                    matrix[0, 0] + matrix[1, 1] + matrix[2, 2],
                    matrix[2, 1] - matrix[1, 2],
                    matrix[0, 2] - matrix[2, 0],
                    matrix[1, 0] - matrix[0, 1],
                ],
                [
                    matrix[2, 1] - matrix[1, 2],
                    matrix[0, 0] - matrix[1, 1] - matrix[2, 2],
                    matrix[0, 1] + matrix[1, 0],
                    matrix[0, 2] + matrix[2, 0],
                ],
                [
                    matrix[0, 2] - matrix[2, 0],
                    matrix[0, 1] + matrix[1, 0],
                    matrix[1, 1] - matrix[0, 0] - matrix[2, 2],
                    matrix[1, 2] + matrix[2, 1],
                ],
                [
                    matrix[1, 0] - matrix[0, 1],
                    matrix[0, 2] + matrix[2, 0],
                    matrix[1, 2] + matrix[2, 1],
                    matrix[2, 2] - matrix[0, 0] - matrix[1, 1],
                ],
            ]
        )
    )
    return np.asarray(vectors[:, np.argmax(values)])


def to_matrix(q: FloatArray) -> FloatArray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_product(a: FloatArray, b: FloatArray) -> FloatArray:
    w, v, u, r = a[0], a[1:], b[0], b[1:]
    return np.concatenate([[w * u - v @ r], w * r + u * v + np.cross(v, r)])


def strapdown(walker: WalkerTruth, begin: int, end: int) -> tuple[FloatArray, FloatArray]:
    """Integrate force and rate alone over pairs of samples: attitude by a fourth-order Magnus
    step on quaternions, velocity and position by Simpson's rule. Gives path and attitude.
    """
    h = walker.time_s[1] - walker.time_s[0]
    force, rate = walker.specific_force_m_s2, walker.angular_rate_rad_s
    q = to_quaternion(walker.attitude[begin])
    position, velocity = walker.position_m[begin].copy(), walker.velocity_m_s[begin].copy()
    gravity = np.array([0.0, 0.0, -GRAVITY_M_S2])
    path = [position.copy()]
    for k in range(begin, end - 1, 2):
        a, b, c = rate[k], rate[k + 1], rate[k + 2]

        def turned(vector: FloatArray, start: FloatArray) -> FloatArray:
            angle = float(np.linalg.norm(vector)) + 1e-300
            half = np.concatenate([[math.cos(angle / 2)], vector / angle * math.sin(angle / 2)])
            return quaternion_product(start, half)

        # Quadratic through the three rates: over the whole pair, and over its first half.
        whole = (a + 4 * b + c) * h / 3 + np.cross(a, c) * (2 * h) ** 2 / 12
        first = (5 * a + 8 * b - c) * h / 12 + np.cross(a, b) * h**2 / 12
        middle, last = turned(first, q), turned(whole, q)
        a0 = to_matrix(q) @ force[k] + gravity
        a1 = to_matrix(middle) @ force[k + 1] + gravity
        a2 = to_matrix(last) @ force[k + 2] + gravity
        # Double integral of the same quadratic over 2h.
        position = position + velocity * 2 * h + (2 * h) ** 2 * (a0 + 2 * a1) / 6
        velocity = velocity + (a0 + 4 * a1 + a2) * h / 3
        q = last / np.linalg.norm(last)
        path.append(position.copy())
    return np.array(path), to_matrix(q)
