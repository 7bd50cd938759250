"""The robot among its obstacles as Pinocchio and Coal see it: what judges use, and solvers never do."""
