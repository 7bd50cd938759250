"""From shards to batches: a dataset opened for training, in an order that is arithmetic and a form that is NumPy."""
