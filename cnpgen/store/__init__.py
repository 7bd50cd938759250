"""Datasets on disk: blueprint, shards, sidecars, manifest and card; the only place that knows their layout."""
