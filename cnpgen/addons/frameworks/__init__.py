"""Bridges to torch and JAX, each imported only if its framework is installed."""
