"""Initialisation: finds the poses of nodes whose start is unknown, for every estimator.

Reported motion and ranges determine the relative poses of walking nodes, but with mirror images,
and with whole circles before anyone has turned. So :mod:`.search` fits many hypotheses at once to
everything logged since the start, weighs them by their evidence (Laplace's approximation: Tierney
and Kadane, JASA 1986), and :mod:`.initialiser` hands a node to the estimator once they agree.
:mod:`.measurement_log` keeps and thins the data, :mod:`.proposals` draws new hypotheses,
:mod:`.hypotheses` stores them, :mod:`.kernels` fits them (Levenberg-Marquardt). Estimators know
only the protocol in :mod:`relpos.fusion.initial_poses`. Begin with
:class:`~relpos.fusion.initialisation.initialiser.HypothesisInitialiser`, then ``search.solve``.
"""
