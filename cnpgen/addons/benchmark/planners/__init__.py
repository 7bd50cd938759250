"""The planners of the benchmark, one per file, found by name (``cnpgen.schema.registry``)."""
