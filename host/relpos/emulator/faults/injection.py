"""Injects faults into an emulated team.

Random faults draw from streams of their own: the same seed and SPECs give the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from relpos.emulator.node import EmulatedNode

from . import boards, chips, host, radio, uwb
from .hooks import Hooks, Rng, Team
from .spec import FaultSpec

_OF_NODE: Mapping[str, Callable[[Hooks, FaultSpec, Rng, EmulatedNode], None]] = {
    "imu": chips.imu,
    "magnetometer": chips.magnetometer,
    "pozyx": chips.pozyx_tag,
    "bus": chips.bus,
    "clock": boards.clock,
    "node": boards.supply,
    "eeprom": boards.eeprom,
}
_OF_TEAM: Mapping[str, Callable[[Hooks, FaultSpec, Rng], None]] = {
    "radio": radio.radio,
    "uwb": uwb.uwb,
    "host": host.host,
}


def inject(team: Team, specs: Sequence[FaultSpec], seed: int) -> None:
    """Install ``specs`` in a team that has just been made."""
    hooks = Hooks(team)
    for index, spec in enumerate(specs):
        rng = np.random.default_rng([seed, index, 0xFA17])
        target = spec.fault.target
        concerned = [n for n in team.nodes.values() if spec.node in (None, n.node)]
        if target in _OF_TEAM:
            _OF_TEAM[target](hooks, spec, rng)
        elif target == "xbee":
            modules = [team.coordinator] if spec.node == 0 else [n.radio for n in concerned]
            for module in modules:
                radio.xbee(hooks, spec, rng.spawn(1)[0], module)
        else:
            for node in concerned:
                _OF_NODE[target](hooks, spec, rng.spawn(1)[0], node)
