"""The shape of a robot: the collision geometry of its URDF as convex pieces, their capsules, its pairs of links."""
