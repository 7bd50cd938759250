"""The page of the elements of scene files that are not used: ``cnpgen docs scene-elements``."""

from collections.abc import Iterator, Mapping

from cnpgen.addons.scene_files.moveit_unused import UNUSED_ELEMENTS as MOVEIT
from cnpgen.addons.scene_files.mpinets_scenes import UNUSED_ELEMENTS as MPINETS
from cnpgen.addons.scene_files.robometrics_scenes import UNUSED_ELEMENTS as ROBOMETRICS

_FORMATS = {"MoveIt YAML": MOVEIT, "HDF5": MPINETS, "robometrics YAML": ROBOMETRICS}
_INTRODUCTION = """\
# Unused elements of scene files

These elements of scene files cannot change the answer. Unused elements are listed when a file is read.
Harmless ones, such as names and time stamps, are not. All other elements are used or refused by name."""


def element_page() -> str:
    """List the elements of all formats that are not used, each with its reason, in Markdown."""
    parts = [_INTRODUCTION]
    for name, elements in _FORMATS.items():
        parts.append(f"## {name}")
        parts += _lists("Harmless", elements.harmless)
        parts += _lists("Listed as unused", elements.unused)
    return "\n\n".join(parts) + "\n"


def _lists(title: str, elements: Mapping[str, str]) -> Iterator[str]:
    """Yield a title and the list of its elements, or nothing without elements."""
    if elements:
        yield f"{title}:"
        # A path that begins with a dot is a whole one.
        yield "\n".join(
            f"- `{path.lstrip('.')}`: {reason}" for path, reason in elements.items()
        )
