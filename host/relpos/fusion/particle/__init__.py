"""The particle filter of the paper (sect. IV): one set of weighted poses for each node.

``--estimator particle`` reproduces the paper's figures and is the baseline that the default
estimator is compared with; its settings are the paper's. Nodes are treated as independent of each
other, so a pair's errors are only as honest as that assumption. A node whose initial pose is
unknown joins once an initialiser, handed in by :mod:`relpos.fusion`, has found it. Begin with
:mod:`~relpos.fusion.particle.particle_set`, which has the method and its equations;
:mod:`~relpos.fusion.particle.estimator` connects it to measurements.
"""
