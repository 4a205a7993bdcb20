"""The boards and everything around them, emulated on a virtual clock.

The production firmware runs natively or on simulated AVR boards, its chips (`mpu9150`, `ak8975`,
`pozyx`) answer register by register on an emulated I2C bus, and XBee modules and both airs connect
the nodes. It serves `relpos demo`, `relpos emulate`, `relpos deadreckon`, the benchmarks and the
tests, which see what real nodes would send. What people do comes from `relpos.simulation`; what
goes wrong from `faults/`. The same config gives the same bytes. Begin with `team.py`, then
`node.py`; `serving.py` puts a team behind a serial port.
"""
