"""A node in somebody's hands, calibrated through the port as a user does it."""

import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest

from relpos.emulator.node import draw_uncalibrated_errors
from relpos.link.dialogue import NodeDialogue
from relpos.link.port import open_port
from relpos.protocol import messages as wire
from support.command import relpos

RELPOS = [sys.executable, "-m", "relpos.cli.main"]


@contextmanager
def emulated(scenario, speed, seconds, seed=3, nodes=1):
    """Path of the pseudo-terminal behind which the node is."""
    command = [*RELPOS, "emulate", "--nodes", nodes, "--scenario", scenario]
    command += ["--speed", speed, "--seconds", seconds, "--seed", seed]
    emulator = subprocess.Popen(
        [*map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        yield re.search(r"/dev/\S+", emulator.stdout.readline())[0]
    finally:
        emulator.send_signal(signal.SIGTERM)
        emulator.wait(30)


def calibrate(*arguments):
    return relpos("node", "calibrate", *arguments, "--yes")


@pytest.mark.soak
def test_a_guided_calibration_makes_the_field_round_and_is_kept_over_a_restart(tmp_path):
    with emulated("turntable", 20, 1500) as port:
        done = calibrate(port, "--node", 1, "--out", tmp_path)
        assert done.exit_code == 0, done.stderr
        assert "stored, restarted and read back" in done.stdout
        # Half a second in each of all workers, for a test of the long runs.
        from matplotlib.image import imread

        assert imread(tmp_path / "node-1-magnetometer.png").shape[0] > 500
        device = open_port(port)
        try:
            dialogue = NodeDialogue(device, 1)
            calibration = dialogue.read_calibration()
            boot = dialogue.boot()
            dialogue.command(wire.CommandCode.REBOOT, 0)
            until_s = time.monotonic() + 60.0
            while dialogue.boot() == boot and time.monotonic() < until_s:
                dialogue.listen()
            assert dialogue.boot() == (boot + 1) % 256
            raw = [s for s in dialogue.raw_samples(30.0) if s is not None]
            assert dialogue.read_calibration().to_words() == calibration.to_words()
        finally:
            device.close()
    field = np.array([s.magnetic_field_ut for s in raw if s.magnetic_field_ut])
    before = np.linalg.norm(field, axis=1)
    after = np.linalg.norm(
        (field - calibration.field_offset_ut) @ calibration.field_matrix.T, axis=1
    )
    assert len(field) > 80
    assert before.std() / before.mean() > 0.1
    assert after.std() / after.mean() < 0.02
    assert 0.05 < np.degrees(calibration.gyro_bias_sigma_rad_s) < 0.3


def test_a_walk_of_known_length_sets_the_gain_on_the_node():
    with emulated("straight", 40, 600) as port:
        done = calibrate("walk", port, "--node", 1, "--distance", 40)
        assert done.exit_code == 0, done.stderr
        device = open_port(port)
        try:
            gain = NodeDialogue(device, 1).setting(wire.CommandCode.SET_STEP_GAIN_PERMILLE)
        finally:
            device.close()
    assert f"-> {gain / 1000:.3f}" in done.stdout


def test_two_antennas_are_calibrated_at_a_known_distance():
    with emulated("bench", 60, 900, nodes=2) as port:
        done = calibrate("antenna", port, "--nodes", "1,2", "--distance", 5, "--ranges", 60)
        assert done.exit_code == 0, done.stderr
        found = re.findall(r"ranges, ([+-][\d.]+) m off \(\+-([\d.]+)\)", done.stdout)
        (before_m, sigma_before_m), (after_m, sigma_after_m) = np.array(found, float)
        # The true sum of the two nodes' delays.
        delay_m = sum(draw_uncalibrated_errors(3, node).antenna_delay_m for node in (1, 2))
        assert sigma_before_m < 0.02 < delay_m / 20
        assert abs(before_m - delay_m) < 5 * sigma_before_m
        assert abs(after_m) < 5 * np.hypot(sigma_before_m, sigma_after_m)


@pytest.mark.soak
def test_a_third_antenna_is_calibrated_against_one_that_keeps_its_offset():
    with emulated("bench", 20, 3000, nodes=3) as port:
        done = calibrate("antenna", port, "--nodes", "1,2", "--distance", 5)
        assert done.exit_code == 0, done.stderr
        delay_m = sum(draw_uncalibrated_errors(3, node).antenna_delay_m for node in (1, 2))
        device = open_port(port)
        try:
            dialogue = NodeDialogue(device, 1)
            first_mm = dialogue.setting(wire.CommandCode.SET_RANGE_OFFSET_MM)
            period_ms = dialogue.setting(wire.CommandCode.SET_RANGING_PERIOD_MS)
        finally:
            device.close()
        assert first_mm == pytest.approx(500 * delay_m, abs=20)
        assert period_ms == 2000
        done = calibrate(
            "antenna", port, "--nodes", "1,3", "--distance", 10, "--reference", 1, "--ranges", 60
        )
        assert done.exit_code == 0, done.stderr
        assert (
            f"node 1: range offset {first_mm / 1000:+.3f} -> {first_mm / 1000:+.3f}" in done.stdout
        )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("/dev/nowhere",), "cannot open"),
        (("antenna", "/dev/nowhere", "--nodes", "1,2", "--distance", 5), "cannot open"),
        (("walk", "/dev/nowhere", "--distance", 20), "cannot open"),
    ],
)
def test_a_missing_port_is_reported_in_one_line(arguments, words):
    done = calibrate(*arguments)
    assert done.exit_code == 1
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
