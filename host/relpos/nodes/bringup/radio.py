"""The radio: whether commands come through, how fast, and what is lost."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from statistics import median

from relpos.errors import DeviceError
from relpos.link.dialogue import ANSWER_S, NodeDialogue
from relpos.nodes.bringup.finding import RADIO, Finding
from relpos.protocol import messages as wire

PINGS = 24
FIRST_PINGS = 4
HELD_S = 0.5
"""A round trip takes a tenth of a second."""
LOST_SHARE = 0.15
"""Of the node's frames: below it no command had to wait because an answer was lost."""
REPEATED_SHARE = 0.25
"""At 2 % loss each way one in 25 is repeated."""
UNCONFIRMED_SHARE = 0.3


def radio_findings(dialogue: NodeDialogue, figures: dict[str, object]) -> Iterator[Finding]:
    """Ping the node; where that is wrong, nothing else can be checked by radio."""
    trips: list[float] = []
    counts = dialogue.link.decoder.nodes[dialogue.node].counts
    before = Counter(counts)
    for _ in range(PINGS):
        begin_s = time.monotonic()
        try:
            dialogue.demand(wire.CommandCode.PING, 0)
        except DeviceError:
            yield Finding(
                RADIO,
                False,
                f"node {dialogue.node} is heard, but takes no command",
                "the module's DOUT to the board's D0: the shield's switch in position XBEE, its "
                "contacts; is the key right?",
            )
            return
        trips.append(time.monotonic() - begin_s)
        if len(trips) == FIRST_PINGS and min(trips) > HELD_S:
            break
    repeated = sum(trip > 0.9 * ANSWER_S for trip in trips)
    figures |= {"round_trip_s": median(trips), "repeated_commands": [repeated, len(trips)]}
    lost, received = (counts[name] - before[name] for name in ("lost", "received"))
    if min(trips) > HELD_S and lost < LOST_SHARE * (lost + received):
        yield Finding(
            RADIO,
            False,
            f"a round trip takes {median(trips):.1f} s",
            "0.1 s is usual: the module holds frames back; sleep mode, or another firmware than "
            "802.15.4? relpos node radio writes its settings",
        )
        return
    share = repeated / len(trips)
    yield Finding(
        RADIO,
        share <= REPEATED_SHARE,
        f"a round trip takes {1e3 * median(trips):.0f} ms, {repeated} of {len(trips)} commands had "
        "to be repeated",
        "nearer to the coordinator? Then the line between module and board: contacts, levels, "
        "38400 baud; and the module's supply",
    )


def meanwhile(
    first: Mapping[str, float], last: Mapping[str, float], heard: int
) -> Iterator[Finding]:
    """What the node's counters say of its radio between two reports with ``heard`` frames."""

    def more(name: str) -> int:
        return int(last[name] - first[name]) & 0xFFFF

    damaged, bad = more("damaged_bytes") + more("lost_bytes"), more("bad_frames")
    unconfirmed = more("radio_failures")
    if damaged or bad:
        yield Finding(
            RADIO,
            False,
            f"{bad} frames and {damaged} bytes came damaged or unasked from the module",
            "it restarted (its supply dips), or the line from its DOUT to D0 is noisy (levels)",
        )
    elif unconfirmed > UNCONFIRMED_SHARE * max(heard, 1):
        yield Finding(
            RADIO,
            False,
            f"{unconfirmed} of {heard} frames were not confirmed in time, though they arrived",
            "the module's firmware (802.15.4, not Zigbee or DigiMesh) and settings: relpos node "
            "radio",
        )
