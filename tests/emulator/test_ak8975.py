"""The emulated AK8975 against its data sheet."""

import numpy as np
import pytest
from chips import Host, constant, words

from relpos.emulator.ak8975 import Ak8975
from relpos.emulator.surroundings import MagneticErrors, draw_magnetic_errors

MAG = 0x0C


@pytest.fixture(params=[False, True], ids=["transactions", "bytes"])
def by_bytes(request):
    return request.param


def chip(field=(20.0, 5.0, -40.0), errors=None, by_bytes=False):
    return Host((MAG, Ak8975(constant(field=field), errors)), by_bytes=by_bytes)


def measured(host, start_us=1000):
    host.at(start_us).write(MAG, 0x0A, 1)
    return host.at(start_us + 10_000).read(MAG, 0x02, 8)


def test_it_says_who_it_is_and_has_nothing_until_it_is_asked(by_bytes):
    host = chip(by_bytes=by_bytes).at(100_000)
    assert host.byte(MAG, 0x00) == 0x48
    assert host.byte(MAG, 0x02) == 0
    assert host.read(MAG, 0x03, 6) == bytes(6)


def test_a_single_shot_is_ready_within_nine_milliseconds_and_not_at_once(by_bytes):
    host = chip(by_bytes=by_bytes).at(1_000)
    host.write(MAG, 0x0A, 1)
    assert host.at(4_000).byte(MAG, 0x02) == 0
    assert host.byte(MAG, 0x0A) == 1
    assert host.at(10_000).byte(MAG, 0x02) == 1
    assert host.byte(MAG, 0x0A) == 0
    host.at(30_000).read(MAG, 0x03, 7)
    assert host.byte(MAG, 0x02) == 0


def test_reading_st2_alone_clears_data_ready():
    host = chip()
    host.at(0).write(MAG, 0x0A, 1)
    host.at(10_000)
    assert host.byte(MAG, 0x02) == 1
    host.byte(MAG, 0x09)
    assert host.byte(MAG, 0x02) == 0


def test_the_axes_are_those_of_the_data_sheet():
    """m_acc = (raw_y, raw_x, -raw_z), 0.3 uT/LSB, little-endian."""
    data = measured(chip(field=(30.0, -12.0, 6.0)))
    raw_x, raw_y, raw_z = words(data[1:7], "little")
    assert (raw_y * 0.3, raw_x * 0.3, -raw_z * 0.3) == pytest.approx((30.0, -12.0, 6.0))


def test_the_factory_gain_is_seen_in_fuse_mode_alone_and_undoes_the_chips_own():
    errors = MagneticErrors(adjustment=(90, 128, 170))
    host = chip(field=(100.0, 200.0, -300.0), errors=errors)
    assert host.read(MAG, 0x10, 3) == bytes(3)
    host.write(MAG, 0x0A, 0xF)
    adjustment = host.read(MAG, 0x10, 3)
    host.write(MAG, 0x0A, 0)
    assert host.read(MAG, 0x10, 3) == bytes(3)
    raw = words(measured(host)[1:7], "little")
    corrected = [r * 0.3 * (a + 128) / 256 for r, a in zip(raw, adjustment, strict=True)]
    assert corrected == pytest.approx([200.0, 100.0, 300.0], abs=0.25)


def test_between_two_modes_lies_power_down():
    host = chip()
    host.write(MAG, 0x0A, 0xF)
    host.write(MAG, 0x0A, 1)
    assert host.at(20_000).byte(MAG, 0x02) == 0
    host.write(MAG, 0x0A, 1)
    assert host.at(40_000).byte(MAG, 0x02) == 1


def test_a_field_past_the_range_saturates_and_is_flagged():
    data = measured(chip(field=(1500.0, 1300.0, 0.0)))
    assert words(data[1:7], "little") == [4095, 4095, 0]
    assert data[7] & 0x08
    assert not measured(chip(field=(50.0, 0.0, 0.0)))[7] & 0x08


def test_data_read_in_the_middle_of_a_conversion_are_marked():
    host = chip()
    host.at(0).write(MAG, 0x0A, 1)
    assert host.at(3_000).read(MAG, 0x03, 7)[6] & 0x04


def test_there_is_no_continuous_mode():
    host = chip()
    host.write(MAG, 0x0A, 2)
    assert host.at(50_000).byte(MAG, 0x02) == 0


def test_noise_and_hard_iron_are_those_of_the_drawn_piece():
    errors = draw_magnetic_errors(np.random.default_rng(3))
    host = chip(errors=errors)
    gain = (np.array(errors.adjustment) + 128) / 256 * 0.3
    rows = np.array([words(measured(host, 20_000 * k)[1:7], "little") for k in range(400)]) * gain
    expected = np.array([5.0, 20.0, 40.0]) + errors.bias_ut
    assert np.allclose(rows.mean(axis=0), expected, atol=0.08)
    assert rows.std(axis=0) == pytest.approx(0.3, rel=0.25)


def test_disabling_its_i2c_silences_it():
    host = chip()
    host.write(MAG, 0x0F, 1)
    assert host.transfer(MAG, b"\0", b"", 1)[0] == 1
