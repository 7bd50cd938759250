"""Folder of results: a file per planner and repetition, all of one suite, version, time limit and seed."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cnpgen.benchmark.benchmark_planner import Setting
from cnpgen.benchmark.results_file import Results, holds_results, open_results, read_results
from cnpgen.benchmark.suite import Suite
from cnpgen.errors import UsageError
from cnpgen.machine.versions import __version__
from cnpgen.problems.problem import resolved
from cnpgen.schema import registry
from cnpgen.store.files.atomic import check_writable
from cnpgen.store.files.documents import canonical_sha256, plain
from cnpgen.store.paths import require_file


class ResultsFolder:
    """Folder for the results of planners on one suite; created if missing.

    Args:
        path: The folder.
        suite: The suite.
        setting: Time limit and seed.

    Raises:
        UsageError: The path is a file.
        MachineError: The folder cannot be created.
    """

    def __init__(self, path: Path, suite: Suite, setting: Setting) -> None:
        if path.exists() and not path.is_dir():
            raise UsageError(f"{path} is a file, expected a folder for the results", concerns="folder")
        check_writable(path)
        path.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._shared = {
            "suite": suite.name,
            "suite_version": suite.version,
            "suite_sha256": canonical_sha256(plain(resolved(replace(suite, planners=None)))),
            "cnpgen": __version__,
            "time_limit_s": setting.time_limit,
            "seed": setting.seed,
        }

    def planners(self, *, delete_others: bool) -> set[str]:
        """Return the planners with results.

        Args:
            delete_others: Whether to delete results of another run.

        Raises:
            UsageError: There are results of another run, and they are not to be deleted.
        """
        names = set()
        for path in sorted(self.path.glob("*.jsonl")):
            require_file(path, "the results of a planner")
            results = read_results(path, self._shared)
            if results is not None:
                names.add(str(results[0]["planner"]))
            elif not holds_results(path):
                continue
            elif delete_others:
                path.unlink()
            else:
                raise UsageError(
                    f"{path} holds results of another run (suite, version, time limit or seed differ);"
                    " {force} deletes them, another folder keeps them",
                    remedies={"force": True},
                )
        return names

    def open(
        self, planner: str, repetition: int, parameters: dict[str, Any], *, overwrite: bool, discard: bool
    ) -> Results:
        """Open the results of a planner and a repetition; see ``open_results``."""
        packages = [entry.dist for entry in registry.installed(registry.PLANNERS) if entry.name == planner]
        identity = {
            **self._shared,
            "planner": planner,
            "planner_version": next((package.version for package in packages if package is not None), __version__),
            "parameters": parameters,
            "repetition": repetition,
        }
        name = f"{planner}.jsonl" if repetition == 0 else f"{planner}.repetition-{repetition}.jsonl"
        return open_results(self.path / name, identity, overwrite=overwrite, discard=discard)

    def rows(self, first: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
        """Return planner -> rows of all results, the given planners first."""
        parts: dict[str, dict[int, Results]] = {name: {} for name in first}
        for path in sorted(self.path.glob("*.jsonl")):
            loaded = read_results(path, self._shared)
            if loaded is not None:
                identity, results = loaded
                parts.setdefault(identity["planner"], {})[identity["repetition"]] = results
        return {
            name: [
                {**row, "repetition": repetition}
                for repetition, results in sorted(repetitions.items())
                for _, row in sorted(results.rows.items())
                if "ending" in row
            ]
            for name, repetitions in parts.items()
        }
