"""Build of the package with hatchling: the addresses of the site, and the libraries of handwritten C."""

import os
import re
import shutil
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

ARRAYS = "kernels/arrays.h"
COLLISION = ("convex", "collision", "tree_search", "manifold_search", "clearance_loss", "hull_rows")  # fmt: skip
LIBRARIES = (  # files of each one in cnpgen/
    (ARRAYS, *(f"kernels/collision/{name}.c" for name in COLLISION)),
    (ARRAYS, "kernels/observation/observe.c"),
    (ARRAYS, "refine/solver/active_set.c", "refine/solver/step.c"),
    (ARRAYS, "planner/time_parametrization.c"),
)
BUILT = "cnpgen/kernels/built"


class SiteAddresses(MetadataHookInterface):  # type: ignore[misc]
    """Sets ``[project.urls]`` from cnpgen/machine/versions.py."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Add the addresses to the metadata."""
        text = (Path(self.root) / "cnpgen" / "machine" / "versions.py").read_text(
            encoding="utf-8"
        )
        found = re.search(r'^DOCUMENTATION_URL = "([^"]*)"', text, re.MULTILINE)
        assert found is not None
        site = found[1]
        pages = {
            "Homepage": "",
            "Documentation": "docs/index.html",
            "Changelog": "CHANGELOG.html",
        }
        metadata["urls"] = {name: site + page for name, page in pages.items() if site}


class CompiledLibraries(BuildHookInterface):  # type: ignore[misc]
    """Compiles handwritten C for a wheel, or in place for an editable installation.

    Without a C compiler the wheel is pure Python, and a machine with one compiles the
    libraries at their first use.
    """

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the libraries, and the platform that they are for, to a wheel."""
        self._folder = Path(self.root) / BUILT
        editable = version == "editable"
        if not editable:
            self._folder = Path(tempfile.mkdtemp(prefix="cnpgen-built-"))
        files = self._compile()
        if editable:
            for old in set(self._folder.glob("*.so")).difference(files):
                old.unlink()
        elif files:
            # Python calls them by ctypes: any version of Python 3 can.
            platform = self.build_config.builder.get_best_matching_tag().split("-")[-1]
            build_data["tag"] = f"py3-none-{platform}"
            build_data["pure_python"] = False
            paths = {str(file): f"{BUILT}/{file.name}" for file in files}
            build_data["force_include"].update(paths)

    def finalize(self, version: str, _data: dict[str, Any], _path: str) -> None:
        """Remove the temporary libraries."""
        if version != "editable":
            shutil.rmtree(self._folder, ignore_errors=True)

    def _compile(self) -> list[Path]:
        """Compile the libraries; return none, with a warning, where that is impossible."""
        sys.path.insert(0, self.root)
        try:
            from cnpgen.errors import MachineError
            from cnpgen.kernels.c_library import build_libraries
        finally:
            sys.path.remove(self.root)
        package = Path(self.root) / "cnpgen"

        def build(names: tuple[str, ...]) -> list[Path]:
            return build_libraries([[package / name for name in names]], self._folder)

        try:
            self._folder.mkdir(exist_ok=True)
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                return [file for files in pool.map(build, LIBRARIES) for file in files]
        except (MachineError, OSError) as error:
            self.app.display_warning(
                f"{error}: handwritten C is compiled at its first use"
            )
            return []
