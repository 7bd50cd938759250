"""Datasets on disk: specification, shards, sidecars, manifest and card. Only this package defines their layout."""
