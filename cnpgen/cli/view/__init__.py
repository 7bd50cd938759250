"""``cnpgen view``: robots, plans and rows as a page that any browser opens."""
