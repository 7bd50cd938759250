"""Validation of datasets, by files, rows, values, documents and blocks, and of this machine."""
