"""``cnpgen init``: recipes for an arm, from its URDF."""

NEEDS = ("manual",)  # its descriptions of keys become comments of recipes
