"""Single simulated wearers of a wide population, doing anything, for benchmarks and tests.

`solo.make_walker(script, seed)` returns the truth of one wearer: `wearer.py` draws the person and
where the sensor sits, `activities/` decides every step of a script, `motion.py` makes the torso's
motion of it. Both share `relpos.simulation.torso` with the walkers of the product's scenarios.
The population and what it was compared with are in docs/gait.md. Begin with `solo.py`.
"""
