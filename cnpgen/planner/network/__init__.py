"""The neural network: features, architecture, forward and backward pass."""
