"""``cnpgen init``: recipes for an arm, from its URDF."""
