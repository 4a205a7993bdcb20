"""`pio run -t upload`, end to end: avrdude writes through a bootloader into a simulated Uno."""

import os
import select
import subprocess
import threading
import tty

import pytest
from boot_loaders import OPTIBOOT_ADDRESS, ROOT, build_optiboot, needs

from relpos.emulator.avr.board import BOARDS, Board, ResetCause

MILLISECOND_CYCLES = 16_000


class SerialBoard(threading.Thread):
    """A board behind a pseudo-terminal; as if DTR had reset it, it starts with the first byte."""

    def __init__(self, board: Board, terminal: int) -> None:
        super().__init__(daemon=True)
        self.board = board
        self.terminal = terminal
        self.stop = threading.Event()
        self.handed_over = threading.Event()

    def run(self) -> None:
        started = False
        while not self.stop.is_set():
            # Simulated time may pass only as fast as avrdude answers: optiboot gives up after 1 s.
            busy = select.select([self.terminal], [], [], 0.001)[0]
            if busy:
                started = True
                cycle = self.board.cycle
                self.board.receive(os.read(self.terminal, 4096), cycle)
            if started:
                self.board.run(self.board.cycle + MILLISECOND_CYCLES)
                sent = bytes(value for _, value in self.board.take_sent())
                while sent:
                    sent = sent[os.write(self.terminal, sent) :]
                # The bootloader hands over to the sketch by letting the watchdog bite.
                if self.board.counters().watchdog_resets:
                    self.handed_over.set()
                    return  # the sketch speaks at another speed


@pytest.mark.skipif(needs() is not None, reason=str(needs()))
def test_upload_writes_and_verifies_the_firmware_through_the_bootloader(tmp_path):
    terminal, port = os.openpty()
    tty.setraw(port)
    with Board(
        BOARDS["uno"],
        build_optiboot(tmp_path),
        line_baud=115200,
        reset_cause=ResetCause.EXTERNAL,
    ) as board:
        board.set_reset_vector(OPTIBOOT_ADDRESS)
        serial_board = SerialBoard(board, terminal)
        serial_board.start()
        try:
            arguments = f"run -e uno -t upload --upload-port {os.ttyname(port)}".split()
            done = subprocess.run(
                [ROOT / "tools" / "pio", *arguments],
                cwd=ROOT,
                capture_output=True,
                text=True,
                timeout=600,
                check=False,
            )
            handed_over = serial_board.handed_over.wait(timeout=60)
        finally:
            serial_board.stop.set()
            serial_board.join()
            os.close(terminal)
            os.close(port)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "bytes of flash verified" in done.stdout + done.stderr
        assert handed_over
