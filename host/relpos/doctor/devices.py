"""Checks of serial ports, and of the coordinator's XBee module behind one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from relpos.doctor.computer import Computer, SerialPort
from relpos.doctor.finding import Finding, State, hint, well, wrong
from relpos.errors import DeviceError

if TYPE_CHECKING:
    import serial

    from relpos.nodes.radio import Access, Parameter

COORDINATOR = 0
SHARED = ("CH", "ID")
"""May have any value that is the same in all modules."""
_CH340 = 0x1A86


def look(
    computer: Computer,
    port: str | None,
    open_port: Callable[[str, int], serial.Serial] | None = None,
) -> Iterator[Finding]:
    """Check the named port and the module behind it, or every port on USB."""
    if port is None:
        yield from _all_ports(computer)
        return
    finding = _port(computer, port)
    yield finding
    yield from _programs_that_grab(computer, [p for p in computer.ports() if p.device == port])
    if finding.state is not State.WRONG:
        yield from _module(port, open_port)


def _all_ports(computer: Computer) -> Iterator[Finding]:
    from relpos.nodes import boards

    ports = [port for port in computer.ports() if port.vid is not None]
    if not ports:
        yield hint(
            "serial ports",
            "none on USB",
            "plug the coordinator in, then: relpos doctor PORT. Without one: relpos emulate",
        )
    known = {c.port: c.what for c in boards.candidates(ports)}
    for port in ports:
        finding = _port(computer, port.device)
        what = known.get(port.device) or port.description
        yield replace(finding, words=f"{what}: {finding.words}")
    yield from _programs_that_grab(computer, ports)


def _port(computer: Computer, port: str) -> Finding:
    name = f"port {port}"
    if "://" in port or computer.platform == "win32":
        return well(name, "not checked before it is opened")
    if not computer.exists(port):
        ports = [p.device for p in computer.ports() if p.vid is not None]
        there = f"plugged in: {', '.join(ports)}" if ports else "no serial port is on USB"
        return wrong(
            name, f"not found; {there}", "check cable and adapter: some cables only charge"
        )
    if not computer.may_use(port):
        return _no_permission(computer, port, name)
    holders = computer.holders(port)
    if holders:
        return wrong(name, f"in use by {', '.join(holders)}", "end that program")
    return well(name, "found, free, with permission")


def _no_permission(computer: Computer, port: str, name: str) -> Finding:
    group = computer.group_of(port)
    words = f"no permission; it belongs to group {group or 'unknown'}"
    if not group or group == "root":
        return wrong(name, words, f"sudo chmod a+rw {port}, or a udev rule that does it each time")
    if computer.has_group_after_login(group):
        return wrong(
            name, f"{words}, which you have joined since your last login", "log out and in"
        )
    return wrong(name, words, f"sudo usermod -aG {group} {computer.user()}, then log out and in")


def _programs_that_grab(computer: Computer, ports: list[SerialPort]) -> Iterator[Finding]:
    """Report services that open new ports for a modem or a Braille display."""
    usb = [p for p in ports if p.vid is not None]
    running = set(computer.processes().values())
    if "ModemManager" in running:
        free = [p.device for p in usb if not _ignored_by_modem_manager(computer, p.device)]
        if free:
            yield hint(
                "ModemManager",
                f"it probes {', '.join(free)} for a modem: for half a minute after plugging in the "
                "port is busy, and the probing disturbs a node's firmware",
                "sudo systemctl disable --now ModemManager, or wait",
            )
    if "brltty" in running and any(p.vid == _CH340 for p in usb):
        yield wrong(
            "brltty",
            "it takes adapters with a CH340 chip for Braille displays and claims their ports",
            "sudo systemctl mask --now brltty-udev.service; sudo apt-get remove brltty",
        )


def _ignored_by_modem_manager(computer: Computer, device: str) -> bool:
    properties = computer.output_of("udevadm", "info", "--query=property", f"--name={device}")
    return "ID_MM_DEVICE_IGNORE=1" in properties or "ID_MM_PORT_IGNORE=1" in properties


# -- the module ------------------------------------------------------------------------------------


def _module(port: str, open_port: Callable[[str, int], serial.Serial] | None) -> Iterator[Finding]:
    from relpos.link.port import open_port as open_serial_port
    from relpos.nodes import radio

    opener = partial(open_port or open_serial_port, port)
    remedy = f"relpos node radio {port} --coordinator"
    name = "coordinator"
    try:
        access = radio.find_module(opener)
    except DeviceError as error:
        yield wrong(
            name,
            str(error),
            "the coordinator is an XBee in a USB adapter, not a node's Arduino",
        )
        return
    try:
        if not isinstance(access, radio.ApiMode):
            yield wrong(
                name,
                f"an XBee at {access.device.baudrate} baud without API frames: factory settings",
                remedy,
            )
        else:
            yield from _settings(access, radio.parameters(COORDINATOR), remedy)
    finally:
        access.device.close()


def _settings(access: Access, wanted: list[Parameter], remedy: str) -> Iterator[Finding]:
    name = "coordinator"
    off: list[str] = []
    unlike: list[str] = []
    for parameter in wanted:
        try:
            value = access.get(parameter.command)
        except DeviceError as error:
            if str(error) not in off:  # each question to a port that has vanished fails alike
                off.append(str(error))
            continue
        if value != parameter.value:
            words = f"{parameter.command}={value:X} instead of {parameter.value:X} "
            words += f"({parameter.meaning})"
            (unlike if parameter.command in SHARED else off).append(words)
    if off:
        yield wrong(name, f"an XBee with other settings: {'; '.join(off)}", remedy)
        return
    if unlike:
        yield hint(
            name,
            f"an XBee on another network: {'; '.join(unlike)}. Fine if all nodes are on it",
            f"{remedy} sets the usual one",
        )
        return
    yield well(name, "an XBee with the right settings")
