"""CasADi SX functions evaluated on whole batches, compiled, interpreted or mapped by CasADi; the robot as SX."""
