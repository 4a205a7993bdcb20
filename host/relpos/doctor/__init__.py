"""Checks of ``relpos doctor``: whether this computer and its coordinator are ready for a team.

``installation`` checks Python, extras, compiled kernels, tools, the team's key, disk space and the
clock; ``devices`` checks serial ports, permissions and the coordinator's XBee module. Each check
yields a ``finding.Finding``: a name, a state (well, hint, wrong), a sentence and a remedy. All
questions to the operating system go through ``computer.Computer``, so that tests can replace it.
The checks change nothing. Begin with ``installation.look``.
"""
