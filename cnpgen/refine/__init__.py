"""The refiner: B-spline trajectory optimization by sequential quadratic programming."""
