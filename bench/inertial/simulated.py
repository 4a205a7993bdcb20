"""Dead reckoning on the simulator's wearers: heading and distance against their truth.

Run as ``.venv/bin/python bench/inertial/simulated.py [--seeds N] [--seconds S]``. Simulator and
filter share the inverted pendulum: these figures check consistency, they are no accuracy.
"""

from __future__ import annotations

import argparse

import numpy as np
import replay
from scipy.signal import butter, sosfiltfilt

from relpos.simulation.team import make_team

BIAS_RAD_S = np.radians(1.0)  # sd of the constant gyroscope bias
RATE_NOISE_RAD_S = np.radians(0.05)  # per 50 Hz sample after the DLPF
FORCE_NOISE_M_S2 = 0.03


def main() -> None:
    """Print a line a wearer and the team's summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--magnetometer", action="store_true")
    parser.add_argument("--begin", type=float, default=0.0, help="switch on so late")
    options = parser.parse_args()
    sos = butter(2, replay.BANDWIDTH_HZ / 100.0, output="sos")
    heading_deg, scale, nees = [], [], []
    for seed in range(options.seeds):
        rng = np.random.default_rng(seed)
        for walker in make_team("paper", 6, options.seconds, seed)[0]:
            imu = np.hstack([walker.specific_force_m_s2, walker.angular_rate_rad_s])
            first = int(options.begin * 200)
            imu = sosfiltfilt(sos, imu, axis=0)[first::4]
            imu[:, :3] += FORCE_NOISE_M_S2 * rng.standard_normal((len(imu), 3))
            imu[:, 3:] += RATE_NOISE_RAD_S * rng.standard_normal((len(imu), 3))
            imu[:, 3:] += BIAS_RAD_S * rng.standard_normal(3)
            field = walker.magnetic_field_ut[first::4] if options.magnetometer else None
            result = replay.reckon(imu, field, leg_length_m=walker.person.leg_length_m)
            rows = result.rows
            true = np.unwrap(walker.heading_rad[first::4])
            error = np.unwrap(rows["heading_rad"]) - (true - true[:100].mean())
            late = error[-500:].mean()
            steps = walker.steps
            walked = float(steps.length_m[steps.time_s > options.begin].sum())
            heading_deg.append(np.degrees(late))
            scale.append(result.distance_m / walked - 1.0)
            nees.append(late**2 / rows["variance_heading_rad2"][-1])
            print(
                f"  seed {seed} node {walker.node}: heading {heading_deg[-1]:+7.1f} deg, distance "
                f"{100 * scale[-1]:+5.1f} %, forward {np.degrees(rows['forward_rad'][-1]):+5.0f} "
                f"deg, {result.counters}"
            )
    minutes = options.seconds / 60.0
    a = np.abs(np.array(heading_deg))
    print(
        f"heading error after {options.seconds:.0f} s: median {np.median(a):.1f}, worst "
        f"{a.max():.1f} deg ({np.median(a) / minutes:.2f} deg/min median); distance "
        f"{100 * np.mean(scale):+.1f} +- {100 * np.std(scale):.1f} %; heading NEES "
        f"{np.mean(nees):.2f} mean, {np.median(nees):.2f} median"
    )


if __name__ == "__main__":
    main()
