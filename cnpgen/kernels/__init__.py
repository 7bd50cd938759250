"""Kernels: CasADi SX functions evaluated on whole batches, compiled, interpreted or mapped by CasADi."""
