"""Conversion between run directories, recordings and the formats of other tools.

``relpos convert`` uses this package: it reads and writes TUM trajectories (evo), GeoJSON and GPX
for maps, CSV tables with names for pandas, MCAP recordings and run directories. Every reader
returns a :class:`~relpos.exchange.content.Content` and every writer takes one, so that a new
format is one file here. Positions on a map need one or more pins, which :mod:`relpos.geodesy`
fits. Begin reading with :mod:`relpos.exchange.convert`; docs/exchange.md says what each format
holds.
"""
