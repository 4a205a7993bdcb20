"""The nodes as devices: their health, settings, radios, boards and firmware.

``monitor`` collects what each node and its link report, and ``health`` turns that into green,
yellow or red with reasons. ``settings`` lists what can be set on a node, and ``antenna`` measures
ranges for the calibration of two nodes. ``boards`` finds and identifies Arduinos, ``upload`` writes
the firmware with PlatformIO, ``radio`` sets up XBee modules, ``cable`` talks to a node over USB.
The commands of ``relpos node`` and the checks of ``relpos doctor`` use it. Begin with ``monitor``.
"""
