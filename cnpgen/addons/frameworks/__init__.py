"""Bridges to torch, JAX and TensorFlow, each imported only if its framework is installed."""
