"""Which kernels sessions call, and for which types: so that they can be compiled side by side.

A kernel is compiled for the types it is first called with, so one process that rehearses a session
compiles one kernel after another. What stands here is compiled by several processes at once
(:mod:`relpos.fusion.machine_code`), the longest first; what does not, or no longer, fit is compiled
by the rehearsal that follows, only later. A test compares.

Types: ``f``, ``i``, ``u``, ``b`` are 64-bit floating-point numbers, whole numbers, those without a
sign, and truth values; with a digit behind, arrays in C's order with so many axes.
"""

from __future__ import annotations

from collections.abc import Mapping

BANK: Mapping[str, str] = {
    "bank_kernels.take_ranges": (
        "f3 f3 f2 f2 f5 i1 i1 i1 f1 f1 f1 f1 f1 f2 f1 f1 f2 f1 f1 f1 f1 b f3 f2 f f4 f1"
    ),
    "starts_kernels.fit": "f2 i f1 f3 i2 f3 f2 i1 f3 f1 f i2 i1 f2 f3 f1 f1 f3",
    "joint.advance": "f3 f3 f4 f5 i1 f2 f2 f f",
    "joint.moments": "f3 f3 f2 i i1 i i",
    "bank_kernels.teach": "i1 i1 i f1 f1 f1 f1 f1 f2 f2 f1",
    "bank_kernels.step_bend": "f3 f3 f2 f1 f1 f1 f1 i f2 f2",
    "bank_kernels.prepare_motion": "i1 f2 f2 f4 i f1 f2 f1",
    "joint.hearing": "f3 f3 f2 i i1 i1 f1 b1 f1 f f1 f",
    "joint._take": "f3 i1 f3",
    "joint.update_heading": "f3 f3 f2 i i f f f f",
    "joint.predicted_ranges": "f3 f3 f2 i1 i1 f1",
    "hypotheses.bend": "f1 f2 f f1",
    "bank_kernels.pairs": "f1 f2 i1",
    "bank_kernels.spread_levels": "f3 f2 f1 f2 f f4 f2",
    "bank_kernels.undoubted_weights": "f2 f1 f2",
    "bank_kernels.normalise": "f2 i f2",
    "bank_kernels.temper": "f2 f1",
    "bank_kernels.within": "i1 i1 i",
    "bank_kernels.is_even": "f3 f2 f2 i1 i f",
    "bank_kernels.surprises": "f1 f1 f1",
    "bank_kernels.expect_outliers": "f1 f1",
    "joint._pack": "f2 f3 i1 f3 f3",
    "joint._unpack": "f3 f3 i1 f2 f3",
    "lanes.working_lines": "i",
}
"""Of the joint filter and of the search for unknown starts."""

LARGE_TEAM: Mapping[str, str] = {
    "neighbourhood_kernels.pass_time": "f1 i1 i1 i1 i1 i1 f2 f2",
    "neighbourhood_kernels.gather": "f2 i1 i1 f1 f1 f1 i1 i1 i1 i1 i1 f1 f1 f1 f1",
    "neighbourhood_kernels.advance": "f2 f2 f2 f1 i1 f2",
    "neighbourhood_kernels.pair_spread": "f1 i1 i1 i1 i1 i1 f2 i1 i1",
    "neighbourhood_kernels.mirror": "f1 i1 i1",
    "neighbourhood_kernels.marginals": "f1 i1 i1 i1 i1",
    "noise.learn": "f1 f2 i1 i1 f1 f3 f1 f1 f1",
}
"""Of what a bank grows into (:mod:`relpos.fusion.growing`)."""

PARTICLE: Mapping[str, str] = {
    "particle_kernels.dual_step": "f3 f2 f2 f2 i1 i1 f1 f1 f f f f2",
    "particle_kernels.correct": "f3 f2 f2 i1 i1 f1 f1 f f f2",
    "particle_kernels.resample": "f3 f2 i1 f2",
    "particle_kernels.moments": "f3 f2 f2",
    "particle_kernels.directed": "i1 i1 i",
    "particle_kernels.advance": "f3 i1 f2 f2 f1",
    "particle_kernels.normals": "u1 f1",
    "particle_kernels.means": "f3 f2 f2",
    "particle_kernels.effective_sizes": "f2 f1",
}
"""Of the particle filter."""

OF: Mapping[str, Mapping[str, str]] = {
    "bank": BANK,
    "particle": PARTICLE,
    "deadreckoning": {},
}
"""Estimator -> its kernels."""

LATER: Mapping[str, Mapping[str, str]] = {"bank": LARGE_TEAM}
"""Estimator -> kernels that no session begins with."""

TYPES: Mapping[str, str] = {**BANK, **LARGE_TEAM, **PARTICLE}
"""All of them."""
