"""Commands to one node, repeated until it answers, and what it reports meanwhile.

A command's token makes repetition harmless: the node answers it again and executes it once.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import serial

from relpos.calibration.sensors import SensorCalibration, checksum
from relpos.errors import DeviceError
from relpos.link.decoder import MAX_KEPT, Acknowledged
from relpos.link.port import Line, Link, observe, send, stopwatch
from relpos.measurements import Observation, RawSample
from relpos.protocol import framing
from relpos.protocol import messages as wire

ANSWER_S = 1.0
"""A full frame each way takes 50 ms, storing the settings on the node 0.4 s."""
ADDRESSED_ATTEMPTS = 2
"""To the node's radio address alone, whose module repeats by itself. At 2 % loss each way both fail
once in 600 times."""
FURTHER_ATTEMPTS = 12
"""To that address and to everybody, twice as often: a node whose module has another address hears
only the latter. Where half of all frames are lost, all of them fail once in a thousand times."""
BUSY_ATTEMPTS = 6
SILENT_S = 6.0
"""A node that is on reports its motion every second."""
NEEDS_CABLE = (
    "node {node} has no key yet: by radio everybody could read its first one. Connect its USB "
    "cable (the shield's switch in position USB) and repeat with --cable and that cable's port"
)
IMPOSSIBLE = -(2**31)
"""A value outside every setting's range."""
RAW_REPORTS_PER_S = 5
MAX_RAW_REPORTS = 3000


class NodeDialogue:
    """Talks to ``node`` over an open coordinator ``port``.

    ``clock`` is that of :func:`relpos.link.port.observe`. Frames that arrive during the wait for an
    answer are processed: raw samples collect in the link's decoder, running totals in its tracks.
    """

    def __init__(
        self,
        port: Line,
        node: int,
        link: Link | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self.node = node
        self.link = link or Link()
        self._port = port
        self._clock = clock or stopwatch()
        self._batches = observe(port, self.link, self._clock)
        self._answers: dict[int, Acknowledged] = {}
        self.observations: deque[Observation] = deque(maxlen=MAX_KEPT)
        """The newest observations of all nodes."""

    def listen(self) -> None:
        """Process what has arrived, or wait a moment for it; DeviceError where the port is gone."""
        try:
            batch = next(self._batches)
        except BaseException:  # also Ctrl-C, after which a node may have to be told to stop
            self._batches = observe(self._port, self.link, self._clock)
            raise
        self.observations.extend(batch)
        send(self._port, self.link.challenges())
        acknowledged = self.link.decoder.acknowledged
        while acknowledged:
            answer = acknowledged.popleft()
            if answer.node == self.node:
                self._answers[answer.token] = answer

    def pause(self, seconds: float) -> None:
        """Process what arrives for that long."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            self.listen()

    def heard(self) -> list[int]:
        """Return the nodes heard within :data:`SILENT_S`."""
        self.pause(SILENT_S)
        return sorted(self.link.decoder.nodes)

    def totals(self) -> Mapping[str, Any] | None:
        """Return the values (SI) of the node's newest motion message; None before the first."""
        track = self.link.decoder.nodes.get(self.node)
        return None if track is None else track.totals

    def boot(self) -> int | None:
        """Return the node's boot counter; None before its first frame."""
        track = self.link.decoder.nodes.get(self.node)
        return None if track is None else track.boot

    def command(self, code: wire.CommandCode, value: int) -> Acknowledged:
        """Send a command, repeat it until the node answers, and return the answer.

        A busy node is asked again. DeviceError where the node does not answer.
        """
        for _ in range(BUSY_ATTEMPTS):
            answer = self._ask(code, value)
            if answer.result != wire.CommandResult.BUSY:
                return answer
        raise DeviceError(f"node {self.node} stays busy and does not take {code.name}")

    def _ask(self, code: wire.CommandCode, value: int) -> Acknowledged:
        token = self.link.next_token()
        for attempt in range(ADDRESSED_ATTEMPTS + FURTHER_ATTEMPTS):
            further = attempt >= ADDRESSED_ATTEMPTS
            _, data = self.link.command(self.node, code, value, token=token)
            if further:
                data += self.link.command(self.node, code, value, token=token, broadcast=True)[1]
            answer = self._send(token, data, ANSWER_S / 2 if further else ANSWER_S)
            # The node refuses a counter, not the command: the link goes on from the node's.
            if answer is not None and answer.result != wire.CommandResult.COUNTER_REFUSED:
                return answer
        raise DeviceError(
            f"node {self.node} does not answer {code.name}: is it switched on and in reach, is its "
            f"number {self.node}, and is the key right?" + self._heard()
        )

    def _send(self, token: int, data: bytes, wait_s: float = ANSWER_S) -> Acknowledged | None:
        """Send once; return the answer, or None where none comes in time."""
        try:
            self._port.write(data)
        except (serial.SerialException, OSError) as error:
            raise DeviceError(f"{self._port.port}: the port vanished") from error
        until_s = time.monotonic() + wait_s
        while time.monotonic() < until_s:
            self.listen()
            answer = self._answers.pop(token, None)
            if answer is not None:
                return answer
        return None

    def _heard(self) -> str:
        others = sorted(set(self.link.decoder.nodes) - {self.node})
        heard = f" Heard: node {', '.join(map(str, others))}." if others else ""
        fault = self.link.clock_fault()
        return heard + (f" And {fault}." if fault else "")

    def demand(self, code: wire.CommandCode, value: int) -> int:
        """Return the value in force after a command; DeviceError where the node refuses it."""
        answer = self.command(code, value)
        if answer.result != wire.CommandResult.DONE:
            raise DeviceError(
                f"node {self.node} refuses {code.name} {value} "
                f"({answer.result.name.lower().replace('_', ' ')})"
            )
        return answer.value

    def setting(self, code: wire.CommandCode) -> int:
        """Return the value of a setting, by setting an impossible one, which changes nothing."""
        answer = self.command(code, IMPOSSIBLE)
        if answer.result != wire.CommandResult.OUT_OF_RANGE:
            raise DeviceError(f"node {self.node} does not know {code.name}")
        return answer.value

    def restart(self) -> int:
        """Restart the node and return its new boot counter; DeviceError if it stays silent."""
        return self._demand_restart(wire.CommandCode.REBOOT, 0, "took the command but ")

    # -- number, defaults, key --------------------------------------------------------------------

    def set_node_id(self, node: int) -> None:
        """Give the node another number, and the key of that number first; it restarts.

        The dialogue goes on under that number. Where it broke off in between, it can be repeated
        with the new number's key among the decoder's ``extra_keys``. DeviceError where that number
        is in use, or the node is not heard under it.
        """
        if node == self.node:
            return
        if node in self.link.decoder.nodes or self._is_in_use(node):
            raise DeviceError(f"there is a node {node} already: numbers must differ")
        if not self.link.keyless:
            self._give_keys(self.link.key, node)
        try:
            self.demand(wire.CommandCode.SET_NODE_ID, node)
        except DeviceError:  # where its answers were lost, it speaks under the new number now
            if node not in self.link.decoder.nodes:
                raise
        self.link.node_keys.pop(self.node, None)
        before, self.node = self.node, node
        if not self._restarted(None):
            raise DeviceError(
                f"node {before} took the number {node} but was not heard with it: switch it off "
                "and on"
            )

    def _is_in_use(self, node: int) -> bool:
        """Return whether a node of that number answers."""
        own, self.node = self.node, node
        try:
            return any(self._answers_under_present_key() for _ in range(ADDRESSED_ATTEMPTS))
        finally:
            self.node = own

    def restore_defaults(self) -> None:
        """Reset all but number and key; the node restarts. DeviceError if it stays silent."""
        self._demand_restart(wire.CommandCode.RESTORE_DEFAULTS, 0)

    def set_key(self, key: bytes) -> bool:
        """Give the node its key and the beacon's of the team's new ``key``.

        Return False where it had them already. The dialogue then uses the new key. DeviceError
        where the node answers under neither, or needs its cable.
        """
        changed = self._give_keys(key, self.node)
        self.link.node_keys.pop(self.node, None)
        self.link.accept_keys(key)
        return changed

    def _give_keys(self, team_key: bytes, node: int) -> bool:
        """Give the node the keys of number ``node``; return False where it had them already.

        The link then holds its key in ``node_keys``. DeviceError: see :meth:`set_key`.
        """
        link, node_keys = self.link, self.link.node_keys
        old, new = link.key_of(self.node), framing.node_key(team_key, node)
        if old == new:
            self.demand(wire.CommandCode.PING, 0)
            return False
        link.decoder.extra_keys[self.node] = (old, new)
        node_keys[self.node] = new
        if self._answers_under_present_key():
            return False
        node_keys[self.node] = old
        if old == wire.DEFAULT_KEY and not getattr(self._port, "by_cable", False):
            raise DeviceError(NEEDS_CABLE.format(node=self.node))
        keys = new + framing.node_key(team_key, wire.BROADCAST)
        token = self.link.next_token()
        for _ in range(FURTHER_ATTEMPTS):
            answer = self._send(token, link.new_keys(self.node, keys, token=token))
            # It answers under the new key, also where that answer is lost: the old key is gone.
            node_keys[self.node] = new
            done = answer is not None and answer.result == wire.CommandResult.DONE
            if done or self._answers_under_present_key():
                return True
            node_keys[self.node] = old
        raise DeviceError(
            f"node {self.node} does not answer: neither under the key that it should have nor "
            "under the new one." + self._heard()
        )

    def _answers_under_present_key(self) -> bool:
        token = self.link.next_token()
        data = b"".join(
            self.link.command(
                self.node, wire.CommandCode.PING, 0, token=token, broadcast=broadcast
            )[1]
            for broadcast in (False, True)
        )
        return self._send(token, data) is not None

    def _demand_restart(self, code: wire.CommandCode, value: int, took: str = "") -> int:
        """Demand what a node restarts after, and wait for that; return the new boot counter."""
        boot = self.boot()
        self.demand(code, value)
        if not self._restarted(boot):
            raise DeviceError(f"node {self.node} {took}was not heard again: switch it off and on")
        new_boot = self.boot()
        assert new_boot is not None
        return new_boot

    def _restarted(self, boot: int | None) -> bool:
        """Wait until the node is heard with another boot; return whether it was."""
        until_s = time.monotonic() + SILENT_S
        while self.boot() == boot and time.monotonic() < until_s:
            self.listen()
        return self.boot() != boot

    # -- raw samples ------------------------------------------------------------------------------

    def raw_samples(self, max_s: float) -> Iterator[RawSample | None]:
        """Yield raw samples for at most ``max_s`` of reports, and None after each silence.

        Reports stop when the iteration ends. DeviceError where none arrives, or the node's sensor
        is silent.
        """
        reports = min(round(max_s * RAW_REPORTS_PER_S), MAX_RAW_REPORTS)
        self.link.decoder.raw_samples.clear()
        self.demand(wire.CommandCode.SET_RAW_REPORTS, reports)
        heard_s = time.monotonic()
        empty = 0
        first_s: float | None = None
        try:
            while True:
                self.listen()
                queue = self.link.decoder.raw_samples
                if not queue and time.monotonic() - heard_s > SILENT_S:
                    if first_s is None:
                        raise DeviceError(
                            f"node {self.node} answers, but no raw samples arrive from it"
                        )
                    return
                if not queue:
                    yield None
                while queue:
                    sample = queue.popleft()
                    if sample.node != self.node:
                        continue
                    heard_s = time.monotonic()
                    first_s = sample.time_s if first_s is None else first_s
                    empty = empty + 1 if sample.acceleration_m_s2 is None else 0
                    if empty > 2 * RAW_REPORTS_PER_S:
                        raise DeviceError(
                            f"node {self.node}: its inertial sensor is silent (wiring, supply)"
                        )
                    yield sample
                    if sample.time_s - first_s >= max_s:
                        return
        finally:
            self.command(wire.CommandCode.SET_RAW_REPORTS, 0)

    # -- calibration ------------------------------------------------------------------------------

    def read_calibration(self) -> SensorCalibration:
        """Return the calibration in force on the node."""
        return SensorCalibration.from_words(
            [
                self.demand(wire.CommandCode.READ_CALIBRATION, index << 16)
                for index in range(len(wire.CALIBRATION))
            ]
        )

    def write_calibration(self, calibration: SensorCalibration) -> None:
        """Store a calibration, wait until the node has restarted with it, and read it back.

        DataError where it does not fit a node, DeviceError where it does not read back.
        """
        words = calibration.to_words()
        for index, word in enumerate(words):
            self.demand(wire.CommandCode.SET_CALIBRATION, index << 16 | word & 0xFFFF)
        commit = wire.CommandCode.COMMIT_CALIBRATION
        self._demand_restart(commit, checksum(words), "took the calibration but ")
        if self.read_calibration().to_words() != words:
            raise DeviceError(
                f"node {self.node} reads back another calibration than was written: its memory "
                "may be worn out; calibrate again"
            )

    # -- steps ------------------------------------------------------------------------------------

    def set_step_gain(self, gain_permille: int) -> None:
        """Set the step gain; DeviceError where another one is in force afterwards."""
        in_force = self.demand(wire.CommandCode.SET_STEP_GAIN_PERMILLE, gain_permille)
        if in_force != gain_permille:
            raise DeviceError(
                f"node {self.node} has a step gain of {in_force / 1000:.3f} instead of "
                f"{gain_permille / 1000:.3f}"
            )


def open_dialogue(port: Line, node: int | None, link: Link | None = None) -> NodeDialogue:
    """Return a dialogue with ``node``, or with the only node that is heard.

    DeviceError where it is not heard, or where none or several are heard without ``node``.
    """
    dialogue = NodeDialogue(port, node or 0, link)
    started_s = time.monotonic()
    decoder = dialogue.link.decoder
    while (waited_s := time.monotonic() - started_s) < SILENT_S:
        dialogue.listen()
        if node is not None and node in decoder.nodes:
            return dialogue
        if node is None and decoder.nodes and waited_s > SILENT_S / 2:
            break
    heard = ", ".join(map(str, sorted(decoder.nodes))) or "none"
    foreign = decoder.counts["FrameTagError"]
    if foreign:
        heard += f", and {foreign} frames under another key (give the team's with --key-file)"
    if node is not None:
        raise DeviceError(f"node {node} is not heard on this port; heard: {heard}")
    if len(decoder.nodes) != 1:
        raise DeviceError(f"which node? Heard: {heard}. Choose one with --node")
    dialogue.node = next(iter(decoder.nodes))
    return dialogue
