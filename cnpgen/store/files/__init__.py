"""Files of any kind: atomic writing, JSON documents, HDF5 and checksums."""
