"""The emulated chips under drivers that others wrote for the real ones."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from chips import GRAVITY, Host, constant

from relpos.emulator.air import UwbAir, VirtualClock
from relpos.emulator.ak8975 import Ak8975
from relpos.emulator.bus import BusStatus
from relpos.emulator.mpu9150 import Mpu9150
from relpos.emulator.pozyx import Pozyx
from relpos.emulator.surroundings import MagneticErrors
from relpos.simulation.world import UwbChannel, World

TAG, MPU, MAG = 0x4B, 0x68, 0x0C
DEGREE = np.pi / 180.0


# ---- Pozyx: the maker's Python library -------------------------------------------------------


class Tags:
    """Two tags 7.321 m apart; time passes while the library sleeps."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        channel = UwbChannel(
            max_range_m=15.0, detection_near=1.0, detection_far=1.0, noise_sigma_m=0.0
        )
        self.air = UwbAir(
            self.clock,
            World(uwb=channel),
            lambda tag, _: np.array([7.321 * (tag.network_id - 1), 0.0, 0.0]),
            np.random.default_rng(1),
        )
        self.hosts = []
        for network_id in (1, 2):
            tag = Pozyx(network_id, self.air, constant(pressure=98_765.4))
            self.air.tags.append(tag)
            self.hosts.append(Host((TAG, tag)))
        self.sleep(0.3)

    def time(self) -> float:
        return self.clock.now_us * 1e-6

    def sleep(self, seconds: float) -> None:
        self.clock.run(self.clock.now_us + max(round(seconds * 1e6), 1))
        for host in self.hosts:
            host.at(self.clock.now_us)

    def transfer(self, first: bytes, second: bytes, count: int) -> bytes:
        self.sleep(0.0005)
        status, data = self.hosts[0].transfer(TAG, first, second, count)
        assert status == BusStatus.OK
        return data


@pytest.fixture
def tags(monkeypatch):
    core = pytest.importorskip("pypozyx.core", reason="the extra 'test' is not installed")
    tags = Tags()
    monkeypatch.setattr(core, "sleep", tags.sleep)
    monkeypatch.setattr(core, "time", tags.time)
    monkeypatch.setattr("pypozyx.lib.sleep", tags.sleep, raising=False)
    return tags


@pytest.fixture
def library(tags):
    """The library on the emulated bus, as its own interface for I2C would be."""
    import pypozyx.lib
    from pypozyx import POZYX_FAILURE, POZYX_SUCCESS

    class OnBus(pypozyx.lib.PozyxLib):
        suppress_warnings = True

        def regRead(self, address, data):  # noqa: N802
            data.load_bytes(tags.transfer(bytes([address]), b"", data.byte_size).hex())
            return POZYX_SUCCESS

        def regWrite(self, address, data):  # noqa: N802
            tags.transfer(bytes([address]), packed(data), 0)
            return POZYX_SUCCESS

        def regFunction(self, address, params, data):  # noqa: N802
            answer = tags.transfer(bytes([address]) + packed(params), b"", data.byte_size + 1)
            if len(data) > 0:
                data.load_bytes(answer[1:].hex())
            return POZYX_SUCCESS if answer[0] == 1 else POZYX_FAILURE

        def waitForFlag(self, flag, timeout_s, interrupt=None):  # noqa: N802
            return self.waitForFlagSafe(flag, timeout_s, interrupt)

    def packed(data) -> bytes:
        data.load_hex_string()
        return bytes.fromhex(data.byte_data)

    return OnBus()


def test_the_makers_library_finds_a_tag_in_order(library):
    from pypozyx import POZYX_SUCCESS, NetworkID, Pressure, SingleRegister, UWBSettings

    who, checked, error = SingleRegister(), SingleRegister(), SingleRegister()
    assert library.getWhoAmI(who) == POZYX_SUCCESS
    assert who[0] == 0x43
    assert library.getSelftest(checked) == POZYX_SUCCESS
    assert checked[0] == 0x3F
    assert library.getErrorCode(error) == POZYX_SUCCESS
    assert error[0] == 0
    pressure = Pressure()
    assert library.getPressure_Pa(pressure) == POZYX_SUCCESS
    assert float(pressure.value) == pytest.approx(98_765.4, abs=0.01)
    settings = UWBSettings()
    assert library.getUWBSettings(settings) == POZYX_SUCCESS
    assert (settings.channel, settings.plen, settings.prf, settings.bitrate) == (5, 8, 2, 0)
    found = NetworkID()
    assert library.setNetworkId(0x1234) == POZYX_SUCCESS
    assert library.getNetworkId(found) == POZYX_SUCCESS
    assert found.id == 0x1234


def test_the_makers_library_ranges(library):
    from pypozyx import POZYX_SUCCESS, DeviceRange

    measured = DeviceRange()
    assert library.doRanging(2, measured) == POZYX_SUCCESS
    assert measured.distance == 7321
    assert -105 <= measured.RSS < -60
    assert 300 < measured.timestamp < 700


def test_the_makers_library_learns_that_a_peer_is_absent(library):
    from pypozyx import POZYX_SUCCESS, DeviceRange, SingleRegister

    assert library.doRanging(9, DeviceRange()) != POZYX_SUCCESS
    error = SingleRegister()
    library.getErrorCode(error)
    assert error[0] in (0x11, 0x12, 0x13, 0x17)


def test_the_makers_library_keeps_its_device_list(library):
    from pypozyx import (
        POZYX_SUCCESS,
        Coordinates,
        DeviceCoordinates,
        DeviceList,
        SingleRegister,
    )

    for device in (0x6001, 0x6002):
        place = DeviceCoordinates(device, 1, Coordinates(1000, -2000, 3000))
        assert library.addDevice(place) == POZYX_SUCCESS
    size = SingleRegister()
    assert library.getDeviceListSize(size) == POZYX_SUCCESS
    devices = DeviceList(list_size=size[0])
    assert library.getDeviceIds(devices) == POZYX_SUCCESS
    assert list(devices.data) == [0x6001, 0x6002]
    place = Coordinates()
    assert library.getDeviceCoordinates(0x6002, place) == POZYX_SUCCESS
    assert (place.x, place.y, place.z) == (1000, -2000, 3000)
    assert library.clearDevices() == POZYX_SUCCESS
    library.getDeviceListSize(size)
    assert size[0] == 0


# ---- MPU-9150: a driver of the MPU-6050, whose registers it has ------------------------------


class Smbus:
    """The two calls of Linux' smbus that the driver needs."""

    host: Host

    def __init__(self, bus: int) -> None:
        assert bus == 1

    def read_byte_data(self, address: int, register: int) -> int:
        return self.host.byte(address, register)

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        self.host.write(address, register, value)


@pytest.mark.parametrize("scale", range(4))
def test_a_driver_of_the_mpu_6050_reads_force_and_rate(monkeypatch, scale):
    force = np.array([0.5, -1.25, 1.75]) * GRAVITY
    rate_deg_s = np.array([100.0, -200.0, 12.5])
    chip = Mpu9150(constant(force=force, rate=rate_deg_s * DEGREE), None, {})
    Smbus.host = Host((MPU, chip)).at(100_000)
    monkeypatch.setitem(sys.modules, "smbus", SimpleNamespace(SMBus=Smbus))
    driver = pytest.importorskip("mpu6050", reason="the extra 'test' is not installed")
    sensor = driver.mpu6050(MPU)
    sensor.set_accel_range(scale << 3)
    sensor.set_gyro_range(scale << 3)
    assert sensor.read_accel_range() == 2 << scale
    assert sensor.read_gyro_range() == 250 << scale
    Smbus.host.at(400_000)
    assert list(sensor.get_accel_data().values()) == pytest.approx(force, abs=0.003 * (1 << scale))
    assert list(sensor.get_gyro_data().values()) == pytest.approx(
        rate_deg_s, abs=0.008 * (1 << scale)
    )


# ---- AK8975: the formula of Linux' driver (drivers/iio/magnetometer/ak8975.c) ----------------


def test_linux_formula_gives_the_field_of_a_compass_with_unequal_gains():
    # H = raw ((ASA - 128) 0.5 / 128 + 1), 0.3 uT a count; a field of (20, 5, -40) uT along the
    # accelerometer's axes is (5, 20, 40) along the compass's own.
    adjustments = (100, 128, 190)
    chip = Ak8975(constant(field=(20.0, 5.0, -40.0)), MagneticErrors(adjustment=adjustments))
    host = Host((MAG, chip)).at(1_000)
    host.write(MAG, 0x0A, 0x0F)
    read = host.read(MAG, 0x10, 3)
    assert tuple(read) == adjustments
    host.write(MAG, 0x0A, 0x00)
    host.write(MAG, 0x0A, 0x01)
    data = host.at(20_000).read(MAG, 0x03, 6)
    raw = np.frombuffer(data, dtype="<i2")
    gain = (np.array(list(read)) - 128.0) * 0.5 / 128.0 + 1.0
    assert raw * 0.3 * gain == pytest.approx([5.0, 20.0, 40.0], abs=0.2)
