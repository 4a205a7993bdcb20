"""The accuracy and consistency of estimates, measured against the truth of a run.

:mod:`relpos.evaluation.metrics` computes the metrics of the run format, ``iso18305`` those of
ISO/IEC 18305:2016, ``consistency`` the NEES (Bar-Shalom et al. 2001) and ``bounds`` the posterior
Cramer-Rao bound (Tichavsky et al. 1998). :mod:`relpos.evaluation.scoring` puts them together: page,
table and JSON show its :class:`~relpos.evaluation.scoring.Evaluation`, and ``report`` draws it.
``study`` repeats scenarios over many seeds, and ``figures`` draws the figures of the paper from
them. Begin reading with :mod:`relpos.evaluation.result`, which runs an estimator over a run.
"""
