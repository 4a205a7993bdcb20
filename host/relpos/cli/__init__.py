"""The command line ``relpos``: each command is arguments in, :mod:`relpos.api`, words out.

Every command has a file of its own and imports heavy libraries inside its body, so that
``relpos --help`` answers at once. Results go to stdout, progress and remarks to stderr
(:mod:`relpos.cli.output`); ``--json`` prints one JSON document. :mod:`relpos.cli.main` turns every
:class:`relpos.RelposError` into one line and exit status 1; :mod:`relpos.cli.start` calls it. Begin
reading with :mod:`relpos.cli.evaluate`, the shortest command, then :mod:`relpos.cli.fuse`.
"""
