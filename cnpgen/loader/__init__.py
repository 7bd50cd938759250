"""Loading a dataset for training: batches of NumPy arrays in a reproducible random order."""
