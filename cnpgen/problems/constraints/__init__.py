"""The constraint manifold: one file per kind of condition, each in a symbolic and in a measured form."""
