"""Solver of the refiner: sequential quadratic programming over the transcribed problem."""
