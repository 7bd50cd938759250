"""Training: from a dataset to a planner, with the loss that needs no demonstrations."""
