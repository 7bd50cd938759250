"""Train planners: loss, network, optimizer, checkpoints and validation."""
