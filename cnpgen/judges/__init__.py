"""The independent judge: rows recomputed with Pinocchio and Coal, sharing no code with the stages or the kernels."""
