"""Worlds and walkers: physical truth for the emulator; and, without chips, measurements at once.

`team.py` makes a scenario's walkers: `walker.py` plans their steps, `gait.py` and `torso.py` turn a
plan into forces and rates at the chest, `world.py` holds ranging, radio, magnetic field and
pressure. The emulated chips measure that truth. `scenarios.py` needs none of it: runs of the paper
(`paper.py`: section V; `lab.py`: section VI), missions and buildings, with their own walkers and
noise, for `relpos simulate`. The same arguments give the same arrays. Begin with `team.py` or
`scenarios.py`.
"""
