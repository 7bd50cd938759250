"""The bridge to LeRobot: a processor step that makes each action chunk of a policy a valid motion.

LeRobot's real-time chunking calls ``postprocessor(actions)`` on a whole chunk, and its
queue then drops the samples that inference took. So the step returns commands at the
times of the chunk's samples: first those of the running motion up to the join, then
those of the joined motion, which rests at the last one.
"""

from __future__ import annotations

from cnpgen.errors import requires_extra

with requires_extra("lerobot", "lerobot"):
    pass
