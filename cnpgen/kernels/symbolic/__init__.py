"""The robot as CasADi SX: what kernels and solvers are built from, and judges never use."""
