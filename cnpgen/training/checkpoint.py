"""Checkpoints: the state of a run and which run it is of, so that another run is not taken for this one."""

import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError, UsageError
from cnpgen.store.files.documents import differences, parse_json
from cnpgen.store.files.sealed import read_sealed, write_sealed
from cnpgen.training.state import State, from_content, to_content

KIND, VERSION = "cnpgen-checkpoint", 1
EVERY, LATEST = 20.0, 50.0  # s of wall time between two checkpoints, and where writing one takes long
SHARE = 20.0  # so many times longer than writing one takes


class Checkpoints:
    """Writes checkpoints of one run, now and then.

    Args:
        path: The file.
        identity: What the run is: settings, dataset, steps; JSON-able.

    Attributes:
        identity: As JSON has it.
    """

    def __init__(self, path: Path, identity: Mapping[str, Any]) -> None:
        self.path = path
        self.identity: dict[str, Any] = json.loads(json.dumps(identity))
        self._next = time.monotonic() + EVERY

    def load(self, *, discard: bool = False) -> State | None:
        """Return the state that the run was left in; None if it has none.

        Args:
            discard: Whether what is damaged or of another run is as if it were not there.

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
        content = read_sealed(self.path, kind=KIND, version=VERSION)
        try:
            found, state = parse_json(content.texts["identity"]), from_content(content)
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"{self.path} does not fit this version of cnpgen: {error!r}") from error
        changed = list(map(str, differences(found, self.identity)))
        if changed:
            raise UsageError(
                f"{self.path} is of another run, it differs in {', '.join(changed[:4])}: give the same arguments to go"
                " on with it, or force=True to throw it away"
            )
        return state

    def save_now_and_then(self, state: State) -> None:
        """Save the state if the last time was long ago."""
        if time.monotonic() > self._next:
            self.save(state)

    def save(self, state: State) -> None:
        """Save the state.

        Raises:
            MachineError: The disk is full, read-only or otherwise unwilling.
        """
        begun, content = time.monotonic(), to_content(state)
        content = replace(content, texts={**content.texts, "identity": json.dumps(self.identity)})
        write_sealed(self.path, content, kind=KIND, version=VERSION)
        took = time.monotonic() - begun
        self._next = time.monotonic() + min(max(EVERY, SHARE * took), LATEST)

    def remove(self) -> None:
        """Remove the file."""
        self.path.unlink(missing_ok=True)
