"""Models of what is measured: the common ground of all estimators, one file a measurement kind.

Each file holds a measurement's equation, its parameters and how they are learned: displacements
(``motion``, ``motion_variances``), ranges (``ranging``), attempts to range (``detection``),
compass headings (``north``), air pressure (``pressure``), what goes wrong with odometry
(``odometry_faults``, ``unseen_walk``) and on which side of others somebody is (``handedness``). The
basic equations are those of Liu et al. 2017, sect. IV. Models know no estimator: estimators import
them. Begin reading at ``motion`` and ``ranging``.
"""
