"""Names of the files in the folder of a dataset.

```
airhockey-replan-v1/
  specification.json        the dataset specification: written first, replaced only by an extension
  train/shard-00000.h5      the samples
  train/shard-00000.json    the sidecar: the commit record of that shard, written after it
  validation/...
  stats.json  README.md  croissant.json    written when all shards are complete
  manifest.json             written last: it exists only for a complete dataset
  _work/                    temporary files; may be deleted at any time
```
"""

import re

SPECIFICATION = "specification.json"
OLD_SPECIFICATION = "plan.json"  # of the formats 1 and 2, which are refused
MANIFEST = "manifest.json"
STATS = "stats.json"
CARD = "README.md"
CROISSANT = "croissant.json"
WORK = "_work"

DESCRIPTIONS = (CARD, CROISSANT)
"""Documents that add-ons write; a dataset is complete without them."""

DOCUMENTS = (SPECIFICATION, MANIFEST, STATS, CARD, CROISSANT)
"""The files of a dataset that do not belong to one shard."""

SPLIT_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,99}")
"""Split names that are valid folder names on every system and valid splits of Hugging Face."""


def shard_stem(split: str, index: int) -> str:
    """Return the path of a shard without its suffix, relative to the folder of the dataset."""
    return f"{split}/shard-{index:05d}"
