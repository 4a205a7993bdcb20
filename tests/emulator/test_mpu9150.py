"""The emulated MPU-9150 against its data sheet; numbers are the data sheet's."""

import numpy as np
import pytest
import scipy
from chips import GRAVITY, Host, constant, of_signal, words

from relpos.emulator import mpu9150
from relpos.emulator.ak8975 import Ak8975
from relpos.emulator.bus import BusStatus
from relpos.emulator.mpu9150 import Mpu9150
from relpos.emulator.surroundings import InertialErrors, draw_inertial_errors

MPU = 0x68
MAG = 0x0C
DEGREE = np.pi / 180.0


def board(surroundings=None, errors=None, by_bytes=False):
    """MPU-9150 and its magnetometer on one bus."""
    surroundings = surroundings or constant()
    auxiliary = {}
    mpu = Mpu9150(surroundings, errors, auxiliary)
    mag = Ak8975(surroundings, reachable=mpu.bypassed)
    auxiliary[MAG] = mag
    return Host((MPU, mpu), (MAG, mag.host_side()), by_bytes=by_bytes)


def configured(host, config=4, divider=19, gyro=1, accel=1, time_us=200_000):
    host.at(time_us)
    for register, value in (
        (0x6B, 1),
        (0x1A, config),
        (0x19, divider),
        (0x1B, gyro << 3),
        (0x1C, accel << 3),
        (0x38, 1),
    ):
        host.write(MPU, register, value)
    return host


@pytest.fixture(params=[False, True], ids=["transactions", "bytes"])
def by_bytes(request):
    return request.param


def test_it_boots_asleep_and_says_who_it_is(by_bytes):
    host = board(by_bytes=by_bytes)
    assert host.byte(MPU, 0x75) == 0x68
    assert host.byte(MPU, 0x6B) == 0x40
    host.write(MPU, 0x38, 1)
    host.at(1_000_000)
    assert host.byte(MPU, 0x3A) == 0
    assert host.read(MPU, 0x3B, 14) == bytes(14)


def test_a_configured_chip_gives_gravity_rate_and_temperature_in_counts(by_bytes):
    host = board(
        constant(
            force=(GRAVITY, -GRAVITY / 2, 0.0),
            rate=(100 * DEGREE, 0.0, -1.01 * DEGREE),
            temperature_c=36.0,
        ),
        by_bytes=by_bytes,
    )
    configured(host).at(400_000)
    ax, ay, az, temperature, gx, gy, gz = words(host.read(MPU, 0x3B, 14))
    assert (ax, ay, az) == (8192, -4096, 0)  # 8192 LSB/g at 4 g
    assert temperature == 340  # raw / 340 + 35
    assert (gx, gy, gz) == (6550, 0, -66)  # 65.5 LSB/(deg/s) at 500 deg/s


@pytest.mark.parametrize(
    ("scale", "lsb_per_g", "lsb_per_dps"),
    [(0, 16384, 131.0), (1, 8192, 65.5), (2, 4096, 32.8), (3, 2048, 16.4)],
)
def test_the_full_scale_bits_choose_the_sensitivity(scale, lsb_per_g, lsb_per_dps):
    host = board(constant(force=(0.5 * GRAVITY, 0, 0), rate=(50 * DEGREE, 0, 0)))
    configured(host, gyro=scale, accel=scale).at(400_000)
    data = words(host.read(MPU, 0x3B, 14))
    assert data[0] == lsb_per_g / 2
    assert data[4] == round(50 * lsb_per_dps)


def test_more_than_full_scale_saturates_and_never_wraps():
    host = board(constant(force=(3 * GRAVITY, -3 * GRAVITY, 0), rate=(20.0, -20.0, 0)))
    configured(host, gyro=0, accel=0).at(400_000)
    data = words(host.read(MPU, 0x3B, 14))
    assert (data[0], data[1]) == (32767, -32768)
    assert (data[4], data[5]) == (32767, -32768)


@pytest.mark.parametrize(
    ("config", "divider", "period_us"),
    [(4, 19, 20_000), (3, 9, 10_000), (1, 0, 1_000), (0, 79, 10_000), (7, 7, 1_000)],
)
def test_data_are_ready_once_every_sample_period(config, divider, period_us, by_bytes):
    host = configured(board(by_bytes=by_bytes), config, divider)
    ready = [t for t in range(201_000, 301_000, 100) if host.at(t).byte(MPU, 0x3A) & 1]
    assert len(ready) == pytest.approx(100_000 / period_us, abs=1)
    assert np.allclose(np.diff(ready), period_us, atol=100)


def test_reading_int_status_clears_it_and_disabled_interrupts_do_not_show(by_bytes):
    host = configured(board(by_bytes=by_bytes)).at(250_000)
    assert host.byte(MPU, 0x3A) == 1
    assert host.byte(MPU, 0x3A) == 0
    host.write(MPU, 0x38, 0)
    assert host.at(300_000).byte(MPU, 0x3A) == 0


def test_the_sample_clock_runs_at_its_own_rate():
    host = configured(board(errors=InertialErrors(sample_clock_ppm=10_000.0)))
    ready = sum(host.at(t).byte(MPU, 0x3A) & 1 for t in range(200_000, 10_200_000, 2_000))
    assert ready == pytest.approx(505, abs=1)


def test_a_reset_restores_the_defaults_and_takes_its_time(by_bytes):
    host = configured(board(by_bytes=by_bytes)).at(300_000)
    host.write(MPU, 0x6B, 0x80)
    host.write(MPU, 0x19, 7)  # too early: lost
    assert host.byte(MPU, 0x6B) & 0x80
    host.at(400_000)
    assert host.byte(MPU, 0x6B) == 0x40
    assert host.byte(MPU, 0x19) == 0
    assert host.byte(MPU, 0x1A) == 0


def test_sleep_freezes_the_data_registers():
    surroundings = of_signal(2.0, force=lambda t: 5.0 * t)
    host = configured(board(surroundings)).at(500_000)
    before = host.read(MPU, 0x3B, 6)
    assert host.byte(MPU, 0x3A) == 1
    host.write(MPU, 0x6B, 0x41)
    host.at(1_500_000)
    assert host.read(MPU, 0x3B, 6) == before
    assert host.byte(MPU, 0x3A) == 0


def test_a_read_past_the_registers_of_a_burst_gives_the_next_ones(by_bytes):
    host = configured(board(by_bytes=by_bytes), divider=19).at(300_000)
    both = host.read(MPU, 0x3A, 15)
    assert both[0] == 1
    assert both[1:] == host.read(MPU, 0x3B, 14)
    assert host.read(MPU, 0x19, 4) == bytes([19, 4, 8, 8])


@pytest.mark.parametrize(
    ("config", "accel_hz", "gyro_hz"),
    [(2, 94, 98), (3, 44, 42), (4, 21, 20), (5, 10, 10), (6, 5, 5)],
)
def test_the_low_pass_has_the_stated_bandwidth(config, accel_hz, gyro_hz):
    """A sine at the stated bandwidth comes out 3 dB down, one far below it untouched."""
    for start, hertz, amplitude, count in (
        (0, accel_hz, 10.0, 8192 / GRAVITY),
        (8, gyro_hz, 4.0, 65.5 / DEGREE),
    ):
        gains = []
        for tone in (hertz, hertz / 10.0):

            def sine(t, tone=tone, amplitude=amplitude):
                return amplitude * np.sin(2 * np.pi * tone * t)

            surroundings = of_signal(4.0, force=sine, rate=sine, rate_hz=2000.0)
            host = configured(board(surroundings), config=config, divider=0)
            values = [
                words(host.at(time_us).read(MPU, 0x3B, 14))[start // 2]
                for time_us in range(1_000_000, 3_000_000, 1_000)
            ]
            gains.append(np.std(values) * np.sqrt(2) / (amplitude * count))
        assert gains[0] == pytest.approx(1 / np.sqrt(2), rel=0.05)
        assert gains[1] == pytest.approx(1.0, rel=0.02)


@pytest.mark.parametrize(("config", "stated_ms"), [(1, 2.0), (2, 3.0), (3, 4.9), (4, 8.5)])
def test_the_low_pass_delays_about_as_stated(config, stated_ms):
    """The delay of a ramp; one sample period of the 1 kHz register is part of it."""
    host = configured(board(of_signal(2.0, force=lambda t: 2.0 * t)), config=config, divider=0)
    value = words(host.at(1_500_000).read(MPU, 0x3B, 2))[0] / 8192 * GRAVITY
    assert (1.5 - value / 2.0) * 1000 == pytest.approx(stated_ms, abs=3.0)


@pytest.mark.parametrize("bandwidth_hz", [5.0, 42.0, 188.0])
def test_the_low_pass_is_scipys_across_the_seam_of_two_blocks(bandwidth_hz):
    raw = np.random.default_rng(5).standard_normal((1000, 3))
    expected = scipy.signal.lfilter(*scipy.signal.butter(2, bandwidth_hz, fs=1000.0), raw, axis=0)
    state, parts = np.zeros((2, 3)), []
    for part in (raw[:400], raw[400:]):
        filtered, state = mpu9150._filtered(bandwidth_hz, part, state)
        parts.append(filtered)
    np.testing.assert_allclose(np.concatenate(parts), expected, rtol=0.0, atol=1e-12)


def test_noise_bias_and_scale_are_those_of_the_drawn_piece():
    errors = draw_inertial_errors(np.random.default_rng(4))
    host = configured(board(errors=errors, surroundings=constant(rate=(0.2, 0.0, 0.0))))
    rows = np.array(
        [words(host.at(t).read(MPU, 0x3B, 14)) for t in range(400_000, 40_400_000, 20_000)],
        dtype=float,
    )
    accel = rows[:, :3] / 8192 * GRAVITY
    gyro = rows[:, 4:] / 65.5 * DEGREE
    expected = errors.accelerometer_gain @ [0, 0, GRAVITY] + errors.accelerometer_bias_m_s2
    assert np.allclose(accel.mean(axis=0), expected, atol=0.005)
    expected = errors.gyroscope_gain @ [0.2, 0, 0] + errors.gyroscope_bias_rad_s
    assert np.allclose(gyro.mean(axis=0), expected, atol=0.0008)
    # Second-order Butterworth of 21 and 20 Hz: noise bandwidth is 1.11 times the bandwidth.
    assert accel.std(axis=0) == pytest.approx(400e-6 * GRAVITY * np.sqrt(21 * 1.11), rel=0.15)
    assert gyro.std(axis=0) == pytest.approx(0.005 * DEGREE * np.sqrt(20 * 1.11), rel=0.25)


def test_the_same_seed_gives_the_same_samples_in_whatever_order_they_are_asked_for():
    errors = draw_inertial_errors(np.random.default_rng(5))
    often = configured(board(errors=errors))
    for time_us in range(200_000, 9_000_000, 20_000):
        often.at(time_us).read(MPU, 0x3B, 14)
    seldom = configured(board(errors=errors))
    assert seldom.at(9_000_000).read(MPU, 0x3B, 14) == often.at(9_000_000).read(MPU, 0x3B, 14)


def test_a_sample_that_comes_in_the_middle_of_a_burst_does_not_tear_it():
    surroundings = of_signal(2.0, force=lambda t: 20.0 * t, rate=lambda t: 5.0 * t)
    host = configured(board(surroundings)).at(518_000)
    bus = host.bus
    expected = host.read(MPU, 0x3B, 14)
    bus.start(MPU, False)
    bus.write(0x3B)
    bus.start(MPU, True)
    got = bytearray()
    for _ in range(14):
        got.append(bus.read())
        bus.time_us += 1_000
    bus.stop()
    assert bytes(got) == expected
    assert host.read(MPU, 0x3B, 14) != expected


def test_a_sample_taken_before_the_range_changed_is_still_announced_in_the_old_counts():
    host = configured(board(constant(force=(GRAVITY, 0, 0))), accel=0).at(300_000)
    host.write(MPU, 0x1C, 1 << 3)
    assert host.byte(MPU, 0x3A) == 1
    assert words(host.read(MPU, 0x3B, 2)) == [16384]
    host.at(325_000)
    assert words(host.read(MPU, 0x3B, 2)) == [8192]


def test_the_fifo_holds_the_enabled_sources_in_register_order(by_bytes):
    host = board(constant(force=(GRAVITY, 0, 0), rate=(0, 0, DEGREE * 100)), by_bytes=by_bytes)
    configured(host)
    host.write(MPU, 0x23, 0x78)
    host.write(MPU, 0x6A, 0x40)
    host.at(200_000 + 10 * 20_000 + 5_000)
    count = int.from_bytes(host.read(MPU, 0x72, 2), "big")
    assert count == 10 * 12
    last = words(host.read(MPU, 0x74, 120)[-12:])
    assert last == [8192, 0, 0, 0, 0, 6550]
    assert host.read(MPU, 0x72, 2) == b"\0\0"
    assert words(host.read(MPU, 0x74, 2)) == [(6550 & 0xFF) * 257 - 65536]  # the last byte again


def test_a_full_fifo_overwrites_the_oldest_and_says_so():
    host = configured(board(), config=1, divider=0)
    host.write(MPU, 0x38, 0x11)
    host.write(MPU, 0x23, 0x78)
    host.write(MPU, 0x6A, 0x40)
    host.at(250_000)
    assert not host.byte(MPU, 0x3A) & 0x10
    host.at(400_000)
    assert host.byte(MPU, 0x3A) & 0x10
    assert int.from_bytes(host.read(MPU, 0x72, 2), "big") == 1024
    host.write(MPU, 0x6A, 0x44)
    assert host.read(MPU, 0x72, 2) == b"\0\0"
    assert host.byte(MPU, 0x6A) == 0x40


def test_the_magnetometer_answers_only_behind_the_bypass(by_bytes):
    host = board(by_bytes=by_bytes)
    assert host.transfer(MAG, b"\0", b"", 1)[0] == BusStatus.ADDRESS_NACK
    host.write(MPU, 0x37, 0x02)
    assert host.read(MAG, 0x00) == b"\x48"
    host.write(MPU, 0x6A, 0x20)
    assert host.transfer(MAG, b"\0", b"", 1)[0] == BusStatus.ADDRESS_NACK


def test_its_own_master_fetches_the_magnetometer(by_bytes):
    host = configured(board(constant(field=(30.0, -12.0, 6.0)), by_bytes=by_bytes))
    for register, value in (
        (0x24, 0x0D),
        (0x25, 0x8C),
        (0x26, 0x02),
        (0x27, 0x88),
        (0x28, 0x0C),
        (0x29, 0x0A),
        (0x2A, 0x81),
        (0x64, 0x01),
        (0x6A, 0x20),
    ):
        host.write(MPU, register, value)
    host.at(400_000)
    data = host.read(MPU, 0x49, 8)
    assert data[0] & 1
    assert words(data[1:7], "little") == [-40, 100, -20]  # chip x is accelerometer y, z is down


def test_a_read_only_register_cannot_be_written():
    host = board()
    host.write(MPU, 0x75, 0x00)
    host.write(MPU, 0x3B, 0x12)
    assert host.byte(MPU, 0x75) == 0x68
    assert host.byte(MPU, 0x3B) == 0


def test_a_silent_span_yields_no_new_sample():
    surroundings = constant()
    object.__setattr__(surroundings, "silent_us", ((500_000, 1_000_000),))
    host = configured(board(surroundings))
    ready = [t for t in range(300_000, 1_400_000, 1_000) if host.at(t).byte(MPU, 0x3A) & 1]
    assert not [t for t in ready if 502_000 < t < 1_000_000]
    assert len([t for t in ready if t >= 1_000_000]) == pytest.approx(20, abs=1)
