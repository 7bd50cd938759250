"""What the files of a dataset folder are called.

```
airhockey-replan-v1/
  plan.json                 what will be made: written first, changed by an extension only
  train/shard-00000.h5      the rows
  train/shard-00000.json    the sidecar: that shard's commit record, written after it
  validation/...
  stats.json  README.md  croissant.json    written at the end
  manifest.json             written last: its existence means that the dataset is complete
  _work/                    temporary files, deletable at any time
```
"""

import re

PLAN = "plan.json"
MANIFEST = "manifest.json"
STATS = "stats.json"
CARD = "README.md"
CROISSANT = "croissant.json"
WORK = "_work"

DOCUMENTS = (PLAN, MANIFEST, STATS, CARD, CROISSANT)
"""The files of a dataset that are not of one shard."""

SPLIT_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,99}")
"""Names that are folders everywhere and splits to Hugging Face."""


def shard_stem(split: str, index: int) -> str:
    """Return the path of a shard without its ending, relative to the dataset's folder."""
    return f"{split}/shard-{index:05d}"
