"""Conversion between run directories, recordings and the formats of other tools.

``relpos convert`` uses this package: it reads and writes TUM trajectories (evo), GeoJSON and GPX
for maps, CSV tables with names for pandas, MCAP recordings and run directories; it writes rosbag2
for ROS 2 and rrd for Rerun. Every reader returns a :class:`~relpos.exchange.content.Content` and
every writer takes one. A new format is a row in :mod:`relpos.exchange.formats`, a file here that
reads or writes it, and the call of that in :mod:`relpos.exchange.convert`. Positions on a map need
one or more pins, which :mod:`relpos.geodesy` fits. Begin reading with
:mod:`relpos.exchange.convert`; docs/exchange.md says what each format holds.
"""
