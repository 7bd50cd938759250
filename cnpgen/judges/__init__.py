"""The independent judges of rows and plans: Pinocchio and Coal, sharing no code with stages, kernels or the refiner."""
