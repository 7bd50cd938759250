"""Datasets on disk: plan, shards, sidecars, manifest and card; the only place that knows their layout."""
