"""Shape of a robot: convex parts of its collision geometry, covering capsules, link pairs."""
