"""Estimators: from measurements to relative positions of the team.

This module is the registry: :func:`make` finds an estimator by its name. The files beside it and
``models/`` are the common ground that every room may import: what an estimator takes and returns
(``estimator``), the order of measurements in time (``timeline``, ``rewind``), models of what is
measured. The rooms know only the common ground, never each other: ``bank/`` (the default, several
hypotheses of a joint filter), ``initialisation/`` (unknown starts), ``large_teams/`` (more than
20 nodes), ``particle/`` (the paper's filter) and ``smoother/`` (a whole run, afterwards).
``switching`` joins them. Begin reading at ``estimator`` and ``timeline``, then in one room.
"""

from __future__ import annotations

import cmath
import random
import subprocess
import sys
from collections.abc import Mapping, Sequence
from itertools import combinations

from relpos.errors import RelposError, interrupts_deferred, interrupts_kept
from relpos.fusion import kernel_cache, plugins
from relpos.fusion.deadreckoning import DeadReckoning
from relpos.fusion.estimator import (
    Alternative,
    Estimate,
    Estimator,
    NodeEstimate,
    NodeStatus,
    PairEstimate,
    Parameter,
    Progress,
    Shape,
)
from relpos.fusion.estimator_settings import (
    SETTINGS,
    BankSettings,
    DeadReckoningSettings,
    ParticleSettings,
)
from relpos.fusion.linear_algebra import one_thread
from relpos.fusion.models.ranging import Mounting
from relpos.fusion.post import referring
from relpos.measurements import Heading, Height, Motion, Prior, Range
from relpos.settings import SettingInfo, describe, parse

ROOMS: Mapping[str, tuple[str, ...]] = {
    "bank": ("bank", "initialisation", "large_teams", "smoother"),
    "particle": ("particle", "initialisation"),
}
"""Estimator name -> the rooms whose kernels it calls."""

SELDOM = ("large_teams", "smoother")
"""Rooms whose kernels are compiled with the others, but loaded where they are called."""


def make(
    name: str,
    priors: Sequence[Prior] = (),
    settings: Mapping[str, object] | None = None,
    seed: int = 0,
    nodes: Mapping[int, Mounting] | None = None,
) -> Estimator:
    """Make an estimator by its name, from ``--set`` keys and values.

    Nodes without a prior start unknown. ``nodes`` tells how each is worn (``run.nodes``): the
    bank uses heights and antenna offsets, the other two are as the paper has them. All take a node
    of the command post for one that lies still. Estimators of others go by ``module:Class`` or by a
    registered name (:mod:`relpos.fusion.plugins`).
    RelposError for an unknown name or key and for a value that is out of range.
    """
    given = settings or {}
    check(name)
    return referring(_make(name, priors, given, seed, nodes), nodes)


def _make(
    name: str,
    priors: Sequence[Prior],
    given: Mapping[str, object],
    seed: int,
    nodes: Mapping[int, Mounting] | None,
) -> Estimator:
    with one_thread():
        match str(name):
            case "bank":
                # Kernels are only loaded where they are used: help texts stay quick.
                from relpos.fusion.switching import SwitchingEstimator

                bank = parse(BankSettings, given, "bank")
                return SwitchingEstimator(priors, bank, seed, nodes or {})
            case "particle":
                from relpos.fusion.initialisation.initialiser import HypothesisInitialiser
                from relpos.fusion.particle.estimator import ParticleFilter

                initialiser = HypothesisInitialiser(seed=seed)
                particle = parse(ParticleSettings, given, "particle")
                return ParticleFilter(priors, initialiser, particle, seed)
            case "deadreckoning":
                reckoning = parse(DeadReckoningSettings, given, "deadreckoning")
                return DeadReckoning(priors, reckoning)
        return plugins.make(name, plugins.factory(name), priors, given, seed, nodes)


def names() -> tuple[str, ...]:
    """Return the names of all estimators: ours, then what installed packages register."""
    return *SETTINGS, *sorted(set(plugins.registered()) - set(SETTINGS))


def check(name: str, settings: Mapping[str, object] | None = None) -> None:
    """Raise RelposError where there is no such estimator, or it has no such settings.

    Nothing is compiled. Settings of an estimator that is not ours are its own affair.
    """
    if name in SETTINGS:
        parse(SETTINGS[name], settings or {}, name)
    elif not plugins.is_plugin(name):
        raise RelposError(
            f"unknown estimator '{name}': one of {', '.join(names())}, or MODULE:CLASS"
        )


def make_smoother(
    name: str,
    priors: Sequence[Prior] = (),
    settings: Mapping[str, object] | None = None,
    seed: int = 0,
    nodes: Mapping[int, Mounting] | None = None,
) -> Estimator:
    """Make a smoother of the whole run that begins from the online estimator ``name``.

    It gives all its estimates at the end. An estimator whose estimates depend on the seed is run
    up to ``SMOOTHER_ATTEMPTS`` times, so that one wrong turn of it does not decide.
    """
    from relpos.fusion.smoother.estimator import Smoother

    check(name)
    attempts = 1 if name == "deadreckoning" else SMOOTHER_ATTEMPTS
    # The others' seeds are far from what a user would choose as the next one.
    seeds = [seed + k * 1_000_003 for k in range(attempts)]
    online, *others = (_make(name, priors, settings or {}, one, nodes) for one in seeds)
    return referring(Smoother(online, others, priors, nodes or {}), nodes)


SMOOTHER_ATTEMPTS = 4


def is_compiled(name: str) -> bool:
    """Whether every kernel of an estimator is in the cache; True of estimators not ours."""
    return kernel_cache.is_complete(ROOMS.get(name, ()))


def warm_up(name: str, progress: Progress | None = None) -> None:
    """Load an estimator's kernels; compile them where they are not in the cache.

    Compiling takes half a minute once after an installation: each room is compiled by a
    process of its own, side by side. ``progress`` is called with ``"compiling"``, the number of
    compiled rooms and that of all. Estimators that are not ours are left alone.
    """
    rooms = [room for room in ROOMS.get(name, ()) if not kernel_cache.is_complete([room])]
    for room in rooms:  # a temporary folder, where it has to be one, is shared with the processes
        kernel_cache.folder_here(kernel_cache.FUSION / room)
    compilers: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for room in rooms:
            words = f"from {__name__} import rehearse; rehearse({room!r})"
            with interrupts_kept():
                compilers[room] = subprocess.Popen([sys.executable, "-c", words])
        for done, (room, process) in enumerate(compilers.items()):
            if progress is not None:
                progress("compiling", done, len(rooms))
            if process.wait() == 0:
                kernel_cache.mark_complete(room)
    finally:
        for process in compilers.values():
            process.kill()
            process.wait()
    for room in ROOMS.get(name, ()):
        if room not in SELDOM:
            with interrupts_deferred():
                rehearse(room, _FEW_S)


_ALL_S, _FEW_S = 25, 4
"""Enough to call every kernel, those that reduce the bank's hypotheses, too; or all usual ones."""


def rehearse(room: str, seconds: int = _ALL_S) -> None:
    """Call the kernels of a room, with a made-up team that walks at random."""
    from relpos.fusion.switching import LARGE_TEAM

    size = LARGE_TEAM + 1 if room == "large_teams" else 6
    places = {node: cmath.rect(8.0, node) for node in range(1, size + 1)}
    pairs = list(combinations(places, 2))
    if room == "initialisation":
        from relpos.fusion.initialisation.initialiser import HypothesisInitialiser

        initialiser = HypothesisInitialiser()
        for node in places:
            initialiser.add(node)
        initialiser.update(
            0.0, [Range(0.0, a, b, abs(places[b] - places[a])) for a, b in pairs], {}, {}
        )
        initialiser.find(0.0)
        return
    priors = [Prior(node, place.real, place.imag, 0.0, 1.0, 0.3) for node, place in places.items()]
    if room == "smoother":
        estimator = make_smoother("deadreckoning", priors)
    else:
        estimator = make("bank" if room == "large_teams" else room, priors)
    rng, headings = random.Random(1), dict.fromkeys(places, 0.0)
    for k in range(1, seconds):
        for node in places:
            turn = rng.gauss(0.0, 0.5)
            places[node] += cmath.rect(1.2, headings[node])
            headings[node] += turn
            estimator.process(Motion(float(k), node, 1.2, 0.0, turn, gain_version=0))
            estimator.process(Height(float(k), node, 0.0, 0.01))
            if k > seconds // 2:  # Without any before, the team turns as a whole.
                estimator.process(Heading(float(k), node, headings[node], 0.2))
        for node, peer in pairs:
            distance_m = abs(places[peer] - places[node])
            estimator.process(Range(float(k), node, peer, abs(distance_m + rng.gauss(0.0, 0.1))))
    estimator.finish()


def settings_of(name: str) -> list[SettingInfo]:
    """List the settings of one of our estimators, with defaults and bounds, for a help text."""
    if name not in SETTINGS:
        raise RelposError(f"unknown estimator '{name}': one of {', '.join(SETTINGS)}")
    return describe(SETTINGS[name])


__all__ = [
    "SETTINGS",
    "Alternative",
    "Estimate",
    "Estimator",
    "NodeEstimate",
    "NodeStatus",
    "PairEstimate",
    "Parameter",
    "SettingInfo",
    "Shape",
    "check",
    "is_compiled",
    "make",
    "make_smoother",
    "names",
    "settings_of",
    "warm_up",
]
