"""The constraint manifold: one file per kind of condition, each written symbolically and as an independent measurement."""
