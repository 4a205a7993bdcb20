"""The inertial library on the simulated Uno is the one that runs on a PC; the others work too."""

from __future__ import annotations

import ctypes
import importlib.util
import sys

import numpy as np
import pytest
from avr_programs import MISSING

from avr import filters

pytestmark = pytest.mark.skipif(MISSING is not None, reason=f"{MISSING} is not installed")

_spec = importlib.util.spec_from_file_location(
    "replay", filters.ROOT / "bench" / "inertial" / "replay.py"
)
assert _spec is not None
assert _spec.loader is not None
replay = importlib.util.module_from_spec(_spec)
sys.modules["replay"] = replay
_spec.loader.exec_module(replay)


def on_this_computer(samples: filters.Samples) -> np.ndarray:
    """Rows of the native library, one a sample, with the same float32 samples."""
    library = replay.build()
    count = len(samples.imu)
    imu = np.ascontiguousarray(samples.imu, dtype=np.float32)
    field = np.ascontiguousarray(samples.field_ut, dtype=np.float32)
    dt = np.full(count, 0.02, dtype=np.float32)
    rows = np.zeros(count, dtype=replay.ROW)
    reckoning = ctypes.c_void_p(library.inertial_create())
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (imu, field, dt, rows)]
    library.inertial_run(
        reckoning, pointers[0], pointers[1], count, filters.FIELD_TICKS, pointers[2], pointers[3]
    )
    library.inertial_destroy(reckoning)
    return rows


@pytest.mark.soak
def test_a_walk_of_310_m_ends_at_the_same_place_on_the_avr() -> None:
    samples = filters.walk(380.0, 5, scenario="paper")
    native = on_this_computer(samples)
    avr = filters.run(filters.build("relpos"), samples).outputs.astype(float)
    assert 280.0 < native["path_m"][-1] < 340.0
    apart_m = np.hypot(avr[:, 0] - native["x_m"], avr[:, 1] - native["y_m"])
    turn_rad = np.abs(np.angle(np.exp(1j * (avr[:, 2] - native["heading_rad"]))))
    assert apart_m.max() < 1e-3
    assert turn_rad.max() < 1e-4


@pytest.mark.parametrize("name", ["mahony", "madgwick"])
@pytest.mark.parametrize("field_ticks", [0, 1])
def test_the_filters_that_ours_is_compared_with_find_the_vertical(
    name: str, field_ticks: int
) -> None:
    # Turned about all axes, without accelerations: the direction of the force is the vertical.
    rng = np.random.default_rng(3)
    count = 1000
    rate = np.radians(40.0) * np.sin(np.outer(np.arange(count) * 0.02, [1.1, 0.7, 1.7]))
    up, north = np.array([0.5, -0.3, 0.8]), np.array([20.0, 5.0, -40.0])
    up /= np.linalg.norm(up)
    force, field = np.zeros((2, count, 3))
    for i in range(count):
        angle = rate[i] * 0.02
        up, north = (v - np.cross(angle, v) for v in (up, north))
        up /= np.linalg.norm(up)
        force[i], field[i] = 9.81 * up, north
    imu = np.hstack([force, rate]) + 0.01 * rng.standard_normal((count, 6))
    samples = filters.with_field_every(
        filters.Samples(imu, field, np.zeros(count, dtype=np.bool_)), field_ticks
    )
    up_found = filters.run(filters.build(name), samples).outputs.astype(float)
    cosine = np.sum(up_found * force, axis=1)[-100:] / 9.81
    assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max() < 2.0
