"""Size limits of untrusted files, checked before memory is allocated.

The limits of recipes are in ``cnpgen.schema.toml``, those of URDFs in
``cnpgen.robots.urdf``.
"""

# HDF5
MAX_HDF5_BYTES = 1 << 36  # of a file
MAX_CHECKSUM_FILE_BYTES = 1 << 30  # of a model or a checkpoint, which are read at once
# Maximum ratio of the unpacked numbers to the size of the file, ...
MAX_EXPANSION = 100
# ... unless the unpacked numbers are smaller than this
MIN_EXPANSION_LIMIT_BYTES = 1 << 24
MAX_DIMENSIONS = 4  # of a dataset
MAX_NAMES = 10_000  # of datasets in a file, or of attributes
MAX_ATTRIBUTE_BYTES = 1 << 24  # of an attribute; the largest ones are URDFs

# tables; a laptop with 8 GB reads all of them
MAX_TABLE_BYTES = 1 << 28  # of binary ones
# CSV, and JSON with samples: they take up to 60 times their size while they are read.
MAX_TEXT_TABLE_BYTES = 1 << 26
MAX_JSON_PARTS = 2_000_000  # lists and objects, of up to 1.6 kB each
MAX_TEXT_ARRAY_BYTES = 1 << 28  # of a column of texts, as wide as the longest one
MAX_TABLE_COLUMNS = 1_000

# JSON
MAX_DOCUMENT_BYTES = 1 << 25  # a manifest of 50,000 shards has 21 MB
MAX_DOCUMENT_DEPTH = 32  # nested tables and lists

# datasets
MAX_SHARDS = 50_000
MAX_FIELDS = 1_000
MAX_COLUMNS = 100_000  # of a field
