"""How large what strangers have written may be; looked at before memory is taken or a loop is entered.

Recipes have limits of their own (``cnpgen.schema.toml``), and so have URDFs (``cnpgen.robots.urdf``).
"""

# HDF5
MOST_BYTES = 1 << 36  # of a file
SEALED_BYTES = 1 << 30  # of a model or a checkpoint, which are read as a whole
EXPANSION = 100  # the numbers of a file, unpacked, may be so many times larger than the file ...
ALWAYS = 1 << 24  # ... or take this many bytes, whatever the file's size
MOST_DIMENSIONS = 4  # of a dataset
MOST_NAMES = 10_000  # of datasets in a file, or of attributes
MOST_ATTRIBUTE_BYTES = 1 << 24  # of an attribute: texts of URDFs are the largest

# CSV
TABLE_BYTES = 1 << 28
TABLE_COLUMNS = 1_000

# JSON
DOCUMENT_BYTES = 1 << 25  # a manifest of 50,000 shards has 21 MB
DOCUMENT_DEPTH = 32  # tables and lists in one another

# datasets
MOST_SHARDS = 50_000
MOST_FIELDS = 1_000
MOST_COLUMNS = 100_000  # of a field
