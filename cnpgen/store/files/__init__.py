"""Whole files of any kind: written at once or not at all, documents, HDF5, sealed arrays."""
