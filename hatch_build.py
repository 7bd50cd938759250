"""Metadata of the package that hatchling computes: the addresses of the site, from cnpgen/machine/versions.py."""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


class SiteAddresses(MetadataHookInterface):  # type: ignore[misc]
    """Sets ``[project.urls]``."""

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
