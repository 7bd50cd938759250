"""Add-ons: packages that a user of data, refiner and planner does not need, each of which can be deleted."""
