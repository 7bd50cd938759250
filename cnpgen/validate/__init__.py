"""Is it right? Datasets by files, rows, numbers, documents and blocks; this machine."""
