"""The refiner: B-spline trajectory optimisation by sequential quadratic programming, and what it falls back on."""
