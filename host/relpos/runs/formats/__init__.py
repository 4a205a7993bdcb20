"""Other people's formats, in and out: TUM trajectories, GeoJSON, GPX, tables for pandas.

Every reader and writer works on a :class:`~relpos.runs.formats.content.Content`; what turns a
path into one, and one into files, is in :mod:`relpos.runs.formats.convert`.
"""
