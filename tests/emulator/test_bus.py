"""The bus: addresses, faults and counts, by bytes as by transactions."""

import pytest
from chips import Host

from relpos.emulator.bus import BusStatus, I2cBus, I2cDevice


class Memory(I2cDevice):
    """Eight bytes that refuse to be written past the end."""

    def __init__(self):
        self.data = bytearray(b"abcdefgh")
        self.place = None
        self.times = []

    def advance(self, time_us):
        self.times.append(time_us)

    def start(self, read):
        if not read:
            self.place = None
        return True

    def write(self, byte):
        if self.place is None:
            self.place = byte
            return True
        if self.place >= 8:
            return False
        self.data[self.place] = byte
        self.place += 1
        return True

    def read(self):
        self.place += 1
        return self.data[self.place - 1]


@pytest.fixture(params=[False, True], ids=["transactions", "bytes"])
def host(request):
    return Host((0x50, Memory()), by_bytes=request.param)


def test_a_register_is_written_and_read(host):
    host.write(0x50, 2, 0x58, 0x59)
    assert host.read(0x50, 1, 4) == b"bXYe"


def test_an_absent_address_is_not_acknowledged(host):
    assert host.transfer(0x51, b"\0", b"", 1) == (BusStatus.ADDRESS_NACK, b"")


def test_a_refused_byte_ends_the_transaction(host):
    assert host.transfer(0x50, b"\x07xy", b"", 0)[0] == BusStatus.DATA_NACK


def test_transactions_are_counted_by_address_and_outcome(host):
    host.read(0x50, 0, 1)
    host.transfer(0x51, b"\0", b"", 1)
    host.transfer(0x50, b"\x08x", b"", 0)
    assert host.bus.transactions == 3
    assert dict(host.bus.counts) == {
        (0x50, BusStatus.OK): 1,
        (0x51, BusStatus.ADDRESS_NACK): 1,
        (0x50, BusStatus.DATA_NACK): 1,
    }


@pytest.mark.parametrize("failure", [BusStatus.ADDRESS_NACK, BusStatus.DATA_NACK])
def test_a_fault_hits_the_transaction_it_names_and_no_other(host, failure):
    host.bus.fault = lambda address, number: failure if number == 1 else None
    assert host.read(0x50, 0, 1) == b"a"
    assert host.transfer(0x50, b"\0z", b"", 0)[0] == failure
    assert host.read(0x50, 0, 1) == b"a"


def test_a_stuck_bus_stays_stuck_until_it_is_released():
    bus = I2cBus()
    bus.attach(0x50, Memory())
    bus.fault = lambda address, number: BusStatus.TIMEOUT if number == 0 else None
    assert bus.transfer(0x50, b"\0", b"", 1)[0] == BusStatus.TIMEOUT
    bus = I2cBus()
    bus.attach(0x50, Memory())
    bus.fault = lambda address, number: BusStatus.TIMEOUT if number == 0 else None
    bus.start(0x50, False)
    assert bus.stuck
    bus.release()
    assert not bus.stuck
    assert bus.start(0x50, False)


def test_chips_live_in_the_buss_time(host):
    host.at(1234).read(0x50, 0, 1)
    assert host.bus.devices[0x50].times[-1] == 1234


@pytest.mark.parametrize("address", [0x07, 0x78])
def test_reserved_addresses_take_no_chip(address):
    with pytest.raises(ValueError, match="address"):
        I2cBus().attach(address, Memory())
