"""What the emulated chip says of a synthesised walk, integrated here by independent means."""

import numpy as np
import scipy
from chips import GRAVITY, Host, words

from relpos.emulator.mpu9150 import Mpu9150
from relpos.emulator.surroundings import Surroundings
from relpos.simulation.team import make_team
from relpos.simulation.walker import RATE_HZ

SECONDS = 60.0


def test_its_rates_turn_as_the_torso_turns_and_its_forces_carry_gravity():
    walker = make_team("paper", 1, SECONDS + 1.0, 1)[0][0]
    chip = Mpu9150(
        Surroundings(
            RATE_HZ,
            walker.specific_force_m_s2,
            walker.angular_rate_rad_s,
            walker.magnetic_field_ut,
            walker.pressure_pa,
        )
    )
    host = Host((0x68, chip))
    for register, value in ((0x6B, 1), (0x1A, 4), (0x19, 19), (0x1B, 8), (0x1C, 8), (0x38, 1)):
        host.write(0x68, register, value)
    rows = np.array(
        [
            words(host.at(t + 100).read(0x68, 0x3B, 14))
            for t in range(20_000, round(SECONDS * 1e6) + 1, 20_000)
        ],
        dtype=float,
    )
    attitude = scipy.spatial.transform.Rotation.from_matrix(walker.attitude[0])
    up = np.zeros(3)
    for force, rate in zip(rows[:, :3] / 8192 * GRAVITY, rows[:, 4:] / 65.536, strict=True):
        attitude = attitude * scipy.spatial.transform.Rotation.from_rotvec(np.radians(rate) * 0.02)
        up += attitude.apply(force) / len(rows)
    true = scipy.spatial.transform.Rotation.from_matrix(walker.attitude[round(SECONDS * RATE_HZ)])
    error = (attitude * true.inv()).as_rotvec()
    # Heading exactly, 0.01 rad in a minute being a gyroscope error of 0.01 deg/s; tilt carries
    # what the walker leans in the filter's 10 ms.
    assert abs(error[2]) < 0.01
    assert np.linalg.norm(error[:2]) < 0.03
    # Over many steps the torso neither rises nor speeds up: the mean force is gravity, upwards.
    assert np.linalg.norm(up - [0.0, 0.0, GRAVITY]) < 0.15
