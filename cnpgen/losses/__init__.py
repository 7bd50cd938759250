"""The loss of a plan, integrals over the phase of time and constraint manifold, its gradient and its metric."""
