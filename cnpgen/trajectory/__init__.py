"""Motions as two B-splines: the path p(s) and the rate r(s) = ds/dt (paper, section on trajectory parameterisation)."""
