"""`relpos node flash`, end to end: a simulated Uno on USB becomes a node and answers by cable."""

import os
import re
import select
import termios
import threading
import time
import tty
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from boot_loaders import ADDRESSES, MEGA_LOADER, build_optiboot, mega_loader, needs

from relpos.cli import node_flash
from relpos.emulator.avr.board import BOARDS as SIMULATED
from relpos.emulator.avr.board import Board, ResetCause
from relpos.errors import DeviceError
from relpos.link import dialogue
from relpos.link import port as link_port
from relpos.link.port import open_port
from relpos.nodes import boards, upload
from support.command import relpos

MILLISECOND_CYCLES = 16_000
ANSWER_MS = 20
"""What a boot loader answers, it answers within about so long: a page of flash takes 4.5 ms."""
PATIENT_MS = 10
"""In which a boot loader that waits for the host grows a millisecond older: it gives up after one
second of its own, however long a busy computer takes."""
PATIENCE_S = 300.0
UCSR0A, UBRR0, U2X0 = 0xC0, 0xC4, 0x02
SPEEDS = {getattr(termios, f"B{baud}"): baud for baud in (9600, 38400, 115200)}


pytestmark = pytest.mark.skipif(needs() is not None, reason=str(needs()))


@pytest.fixture(scope="module")
def optiboot(tmp_path_factory):
    return build_optiboot(tmp_path_factory.mktemp("boot"))


class Arduino(threading.Thread):
    """A board behind a pseudo-terminal that restarts whenever its port is opened, as DTR does it.

    ``connected``: the shield's switch gives the UART to the USB cable, not to the XBee.
    """

    def __init__(self, board, terminal, connected):
        super().__init__(daemon=True)
        self.board = board
        self.terminal = terminal
        self.connected = connected
        self.stop = threading.Event()
        self.failure = None
        self.poll = select.poll()
        self.poll.register(terminal, select.POLLIN | select.POLLHUP)

    def understands(self):
        """Whether the cable reaches the UART, and both ends have the same speed to 3 %."""
        control, divisor = self.board.data(UCSR0A, 1)[0], self.board.data(UBRR0, 2)
        bit_cycles = (8 if control & U2X0 else 16) * (int.from_bytes(divisor, "little") + 1)
        baud = self.board.frequency_hz / bit_cycles
        return self.connected and 0.97 < baud / self.host_baud() < 1.03

    def host_baud(self):
        return SPEEDS[termios.tcgetattr(self.terminal)[5]]

    def run(self):
        try:
            was_open = answering = False
            while not self.stop.wait(0.0005):
                waits = self.host_baud() == boards.BOOT_BAUD and not answering
                patience_ms = PATIENT_MS if waits else 0
                events = dict(self.poll.poll(patience_ms)).get(self.terminal, 0)
                is_open = not events & select.POLLHUP
                if is_open and not was_open:
                    self.board.reset(ResetCause.EXTERNAL)
                was_open = is_open
                if events & select.POLLIN:
                    data = os.read(self.terminal, 4096)
                    if self.understands():
                        self.board.receive(data, self.board.cycle)
                if not is_open:
                    continue
                for _ in range(ANSWER_MS if events & select.POLLIN else 1):
                    self.board.run(self.board.cycle + MILLISECOND_CYCLES)
                    sent = bytes(value for _, value in self.board.take_sent())
                    answering = bool(sent)
                    if sent and self.understands():
                        os.write(self.terminal, sent)
                        break
        except OSError:
            pass
        except BaseException as error:
            self.failure = error


@dataclass
class Plugged:
    path: str
    board: Board


@contextmanager
def plugged(kind, firmware, *, connected=True):
    """A board on USB."""
    terminal, port = os.openpty()
    tty.setraw(port)
    path = os.ttyname(port)
    os.close(port)
    with Board(SIMULATED[kind], firmware, reset_cause=ResetCause.EXTERNAL) as board:
        board.set_reset_vector(ADDRESSES[kind])
        arduino = Arduino(board, terminal, connected)
        arduino.start()
        until_s = time.monotonic() + PATIENCE_S

        def now_s():
            """The board's time: a host waits for as long as it would for a real one."""
            assert arduino.is_alive()
            assert time.monotonic() < until_s
            return board.cycle / board.frequency_hz

        try:
            with pytest.MonkeyPatch.context() as patched:
                clock = SimpleNamespace(monotonic=now_s, time=now_s)
                for module in (dialogue, link_port, node_flash):
                    patched.setattr(module, "time", clock)
                yield Plugged(path, board)
        finally:
            arduino.stop.set()
            arduino.join()
            os.close(terminal)
        if arduino.failure is not None:
            raise arduino.failure


def test_a_board_becomes_a_node_and_answers_over_its_cable(optiboot, tmp_path):
    key = tmp_path / "team.key"
    key.write_text("00112233445566778899aabbccddeeff\n")
    with plugged("uno", optiboot) as uno:
        done = relpos("node", "flash", uno.path, "--board", "uno", "--id", 9, "--key-file", key)
        assert done.exit_code == 0, done.stdout + done.stderr
        assert re.search(r"written and verified \([1-9]\d{4} bytes\)", done.stdout)
        assert "has been given the key" in done.stdout
        assert "node 1 is node 9 now" in done.stdout
        assert "node 9 answers over the cable" in done.stdout
        # And goes on doing so, under its key alone.
        shown = relpos("node", "set", uno.path, "--cable", "--key-file", key, "led", "on")
        assert shown.exit_code == 0, shown.stderr
        assert "Node 9" in shown.stdout
        stranger = relpos("node", "set", uno.path, "--cable")
        assert stranger.exit_code == 1
        assert "under another key" in stranger.stderr


def test_the_wrong_board_is_refused_before_anything_is_written(optiboot):
    with plugged("uno", optiboot) as uno:
        done = relpos("node", "flash", uno.path, "--board", "mega")
        assert done.exit_code == 1
        assert len(done.stderr.strip().splitlines()) == 1
        assert "this is an Arduino uno (ATmega328P), not a mega" in done.stderr
        assert uno.board.counters().eeprom_writes == 0


@pytest.mark.skipif(not MEGA_LOADER.is_file(), reason="no boot loader of the Mega is installed")
def test_a_mega_is_known_by_its_own_boot_loader(tmp_path):
    with (
        plugged("mega", mega_loader()) as mega,
        closing(open_port(mega.path, 115200)) as device,
    ):
        assert boards.check(device, None).name == "mega"
        with pytest.raises(DeviceError, match="not a uno"):
            boards.check(device, "uno")


@pytest.mark.parametrize("of_2011", [True, False])
@pytest.mark.skipif(not MEGA_LOADER.is_file(), reason="no boot loader of the Mega is installed")
def test_a_boot_loader_that_leaves_the_watchdog_armed_is_told(tmp_path, of_2011):
    program = mega_loader()
    if of_2011:  # as that one: without the instruction that feeds the watchdog
        program = replace(program, flash=program.flash.replace(b"\xa8\x95", b"\0\0"))
    with (
        plugged("mega", program) as mega,
        closing(open_port(mega.path, 115200)) as device,
    ):
        warning = boards.warning(device, boards.check(device, None))
    if of_2011:
        assert "leaves the watchdog armed" in warning
    else:
        assert warning is None


@pytest.mark.soak
@pytest.mark.skipif(not MEGA_LOADER.is_file(), reason="no boot loader of the Mega is installed")
def test_a_mega_becomes_a_node_as_well(tmp_path):
    with plugged("mega", mega_loader()) as mega:
        done = relpos("node", "flash", mega.path, "--id", 5)
    assert done.exit_code == 0, done.stdout + done.stderr
    assert "Arduino mega (ATmega2560)" in done.stdout
    assert "node 5 answers over the cable" in done.stdout


def test_the_shields_switch_in_the_wrong_position_is_reported(optiboot):
    with plugged("uno", optiboot, connected=False) as uno:
        done = relpos("node", "flash", uno.path)
    assert done.exit_code == 1
    assert len(done.stderr.strip().splitlines()) == 1
    assert "no board answers" in done.stderr
    assert "switch to USB" in done.stderr


@dataclass
class UsbPort:
    device: str
    vid: int | None = None
    pid: int | None = None


def test_the_only_board_is_found_by_its_usb_id():
    ports = [UsbPort("/dev/ttyS0"), UsbPort("/dev/ttyUSB1", 0x1A86, 0x7523)]
    assert boards.choose(ports) == "/dev/ttyUSB1"
    # Arduino's own id is surer than a bridge chip, which an XBee adapter may have.
    ports += [UsbPort("/dev/ttyACM0", 0x2341, 0x0043), UsbPort("/dev/ttyUSB0", 0x0403, 0x6001)]
    assert boards.choose(ports) == "/dev/ttyACM0"


def test_several_boards_need_a_choice_and_a_missing_board_is_reported():
    several = [UsbPort("/dev/ttyACM0", 0x2341, 0x0043), UsbPort("/dev/ttyACM1", 0x2341, 0x0042)]
    with pytest.raises(
        DeviceError, match=r"ttyACM0 \(Arduino Uno\), /dev/ttyACM1 \(Arduino Mega\)"
    ):
        boards.choose(several)
    with pytest.raises(DeviceError, match="no Arduino"):
        boards.choose([UsbPort("/dev/ttyS0"), UsbPort("/dev/ttyX", 0x1234, 0x1)])


@pytest.mark.parametrize(
    ("output", "words"),
    [
        ("avrdude: stk500_getsync() attempt 10 of 10: not in sync: resp=0x00", "switch to USB"),
        (
            'avrdude: ser_open(): can\'t open device "/dev/x": Device or resource busy',
            "port cannot",
        ),
        (
            "avrdude OS error: cannot open port /dev/x: No such file or directory\n"
            "avrdude error: unable to open programmer arduino on port /dev/x\n\n"
            "avrdude done.  Thank you.\n\n*** [upload] Error 1",
            "vanished",
        ),
        ("avrdude OS error: cannot open port /dev/x: Permission denied", "port cannot"),
        (
            "avrdude: ser_send(): write error: Input/output error\n\n"
            "avrdude done.  Thank you.\n\n*** [upload] Error 1",
            "write error: Input/output error",
        ),
        ("Platform Manager: Installing atmelavr\nHTTPClientError: ", "needs the Internet"),
        (
            "Error: You are not connected to the Internet.\nPlatformIO needs the Internet "
            "connection to download dependent packages",
            "needs the Internet",
        ),
        ("node.cpp:12:3: error: 'x' was not declared\n*** [node.o] Error 1", "does not build"),
        ("avrdude: verification error; content mismatch", "read back"),
        ("Something else\n\n", "Something else"),
        ("", "no reason"),
    ],
)
def test_a_failed_upload_is_reported_with_its_cause(output, words):
    assert words in upload.why(output)
    assert "\n" not in upload.why(output)


@pytest.mark.parametrize(
    ("imu", "flags"), [("mpu9150", None), ("mpu9250", "-Wall -DRELPOS_IMU=MPU9250")]
)
def test_the_firmware_is_built_for_the_sensor_that_is_wired(tmp_path, monkeypatch, imu, flags):
    if flags:
        monkeypatch.setenv("PLATFORMIO_BUILD_FLAGS", "-Wall")
    asked = tmp_path / "asked"
    said = 'printf %s "${PLATFORMIO_BUILD_FLAGS-none}"'
    script = f"{said} >{asked}; echo 30000 bytes of flash verified"
    monkeypatch.setattr(upload, "platformio", lambda _: [made(tmp_path, script)])
    assert upload.upload(boards.BOARDS["uno"], "/dev/x", imu=imu) == 30000
    assert asked.read_text() == (flags or "none")


def made(folder, script):
    """Return the path of a program that stands for PlatformIO."""
    tool = folder / "pio"
    tool.write_text(f"#!/bin/sh\n{script}\n")
    tool.chmod(0o755)
    return str(tool)


def test_an_uploader_that_prints_no_text_is_reported(tmp_path, monkeypatch):
    script = "printf 'port /dev/\\377: error\\n'; exit 1"
    monkeypatch.setattr(upload, "platformio", lambda _: [made(tmp_path, script)])
    with pytest.raises(DeviceError, match="the upload failed: port /dev/\N{REPLACEMENT CHARACTER}"):
        upload.upload(boards.BOARDS["uno"], "/dev/x")


def test_an_uploader_that_hangs_is_ended_with_all_that_it_has_started(tmp_path, monkeypatch):
    script = f"sleep 600 & echo $! >{tmp_path}/pid; wait"
    monkeypatch.setattr(upload, "platformio", lambda _: [made(tmp_path, script)])
    monkeypatch.setattr(upload, "UPLOAD_WITHIN_S", 1.0)
    began_s = time.monotonic()
    with pytest.raises(DeviceError, match=r"^/dev/x: the upload took over 1 s$"):
        upload.upload(boards.BOARDS["uno"], "/dev/x")
    started = Path(f"/proc/{(tmp_path / 'pid').read_text().strip()}/stat")
    with suppress(OSError):  # gone, or nobody's child any more
        while ") Z " not in started.read_text():
            assert time.monotonic() - began_s < 60.0


def test_a_missing_platformio_is_reported(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(DeviceError, match="PlatformIO is missing"):
        upload.platformio(tmp_path)
