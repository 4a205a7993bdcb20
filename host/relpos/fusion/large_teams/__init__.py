"""The filter for large teams: 20 to 1,000 nodes, from recordings and simulations.

The bank's work grows with the square of the team for every hypothesis. Where dozens of nodes range
their neighbours, their poses are rarely ambiguous, and one joint Gaussian that keeps only the
covariances of neighbourhoods takes the bank's place; the cost of a range then depends on the
neighbourhood and not on the team. :mod:`relpos.fusion.switching` chooses between the two and hands
in what finds unknown initial poses. Begin reading with
:mod:`~relpos.fusion.large_teams.sparse_filter`. Covariances between strips follow from those of
adjacent ones as in Gaussian Markov chains (Rue and Held 2005, ch. 2), the posterior from selected
inversion (Takahashi 1973).
"""
