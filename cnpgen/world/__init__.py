"""The robot among its obstacles as Pinocchio and Coal see it: what constraints are measured by."""
