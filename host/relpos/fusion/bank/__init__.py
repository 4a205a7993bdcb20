"""The default estimator of a small team: a bank of joint error-state Kalman filters.

Each hypothesis holds the poses, step scales, heading drifts and range biases of all users with
their joint covariance, and a draw of the variance components; weights and resampling select among
hypotheses (a Rao-Blackwellised particle filter: Doucet, de Freitas, Murphy and Russell 2000, for
the relative localisation problem of the paper in ``README.md``). ``fusion.make("bank")`` uses it
for teams of up to twenty users, and the smoother begins from it.

Begin reading with ``estimator.py`` (measurements in, estimates out) and ``core.py`` (one epoch as
arrays); then ``hypothesis_set.py`` (storage and resampling), ``adaptive_count.py`` and
``relocalisation.py`` (which hypotheses there are), and the kernels, one file a measurement:
``motion_update.py``, ``range_update.py``, ``heading_update.py``, ``detection_update.py``.
``sensors.py`` and ``variance_components.py`` learn the noise; ``mixture.py`` and ``reporting.py``
sum up.

Kernels know no settings. ``hypothesis_set.py`` turns a prior of ``BankSettings`` into a variance in
the covariances; an entry without variance is one that the hypothesis does not model.
"""
