"""Clusters: workers of dask and ray, which run the shards of a dataset or the plans of a refinement."""
