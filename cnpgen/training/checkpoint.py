"""Checkpoints: the state of a run and its identity, so that no other run resumes from it."""

import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError, UsageError
from cnpgen.store.files.checksum_file import read_with_checksum, write_with_checksum
from cnpgen.store.files.documents import differences, parse_json
from cnpgen.training.training_state import State, from_content, to_content

CHECKPOINT_KIND, CHECKPOINT_VERSION = "cnpgen-checkpoint", 2
MIN_INTERVAL_S, MAX_INTERVAL_S = 20.0, 50.0  # wall time between two checkpoints
INTERVAL_PER_WRITING_TIME = 20.0


class Checkpoints:
    """Checkpoints of one run, written at intervals.

    Args:
        path: The file.
        identity: Settings, dataset and steps of the run; JSON-able.

    Attributes:
        identity: The identity after a round trip through JSON.
    """

    def __init__(self, path: Path, identity: Mapping[str, Any]) -> None:
        self.path = path
        self.identity: dict[str, Any] = json.loads(json.dumps(identity))
        self._next = time.monotonic() + MIN_INTERVAL_S

    def load(self, *, discard: bool = False) -> State | None:
        """Return the state of an interrupted run; None if there is none.

        Args:
            discard: Whether to ignore a checkpoint that is damaged or of another run.

        Raises:
            DatasetError: The file is damaged.
            UsageError: It is of another run.
        """
        if not self.path.exists():
            return None
        try:
            return self._load()
        except (DatasetError, UsageError):
            if discard:
                return None
            raise

    def _load(self) -> State:
        content = read_with_checksum(self.path, kind=CHECKPOINT_KIND, version=CHECKPOINT_VERSION)
        try:
            identity, state = parse_json(content.texts["identity"]), from_content(content)
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"{self.path} does not fit this version of cnpgen: {error!r}") from error
        changed = list(map(str, differences(identity, self.identity)))
        if changed:
            raise UsageError(
                f"{self.path} is of another run, it differs in {', '.join(changed[:4])}: give the same arguments to"
                " resume it, or {force} to replace it",
                remedies={"force": True},
            )
        return state

    def save_if_due(self, state: State) -> None:
        """Save the state if the interval has passed."""
        if time.monotonic() > self._next:
            self.save(state)

    def save(self, state: State) -> None:
        """Save the state.

        Raises:
            MachineError: The disk is full or read-only.
        """
        started, content = time.monotonic(), to_content(state)
        content = replace(content, texts={**content.texts, "identity": json.dumps(self.identity)})
        write_with_checksum(self.path, content, kind=CHECKPOINT_KIND, version=CHECKPOINT_VERSION)
        interval = INTERVAL_PER_WRITING_TIME * (time.monotonic() - started)
        self._next = time.monotonic() + min(max(MIN_INTERVAL_S, interval), MAX_INTERVAL_S)

    def remove(self) -> None:
        """Remove the file."""
        self.path.unlink(missing_ok=True)
