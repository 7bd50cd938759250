"""``cnpgen view``: robots, plans and samples as a page that any browser opens."""

NEEDS = ("trajectories",)
