"""Bridges to torch, JAX and LeRobot (the add-on ``cnpgen.addons.frameworks``), each used only if it is installed."""
