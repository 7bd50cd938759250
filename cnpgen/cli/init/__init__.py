"""``cnpgen init``: recipes for anybody's arm, from its URDF."""
