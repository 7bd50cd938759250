"""Bridges to torch and JAX (the add-on ``cnpgen.addons.frameworks``), each used only if its framework is installed."""
