"""The smoother: a whole run's most probable track, from all measurements before and after.

It is for ``relpos fuse --smooth``, after a run. A robust factor graph (Dellaert and Kaess 2017)
over all poses and the hidden constants is solved by Levenberg-Marquardt on block-tridiagonal
normal equations; variance components are estimated by maximum marginal likelihood between the
solutions. Begin reading at :mod:`~relpos.fusion.smoother.estimator` (the interface), then
``solution`` (the alternation), ``graph`` (the run in arrays), ``problem`` (residuals and normal
equations), ``inliers``, ``variance_components`` and ``detection``.
"""
