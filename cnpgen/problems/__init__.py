"""Problems, which define valid motions: constraints, robot, obstacles, and records as text."""
