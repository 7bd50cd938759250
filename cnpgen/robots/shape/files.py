"""The files that a URDF names, mostly meshes: where they are looked for, and where they are found."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import unquote, urlparse

from cnpgen.errors import RecipeError
from cnpgen.schema.catalogue import LONGEST
from cnpgen.schema.units import show

_PACKAGE = ("package", "model")  # URI schemes that begin with the name of a package
_SEARCHED = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")


def find_named_file(name: str, urdf: Path, packages: Sequence[Path] = ()) -> Path:
    """Find a file that a URDF names.

    ``package://NAME/REST`` is looked for in the folders of ``packages``, in those of the environment variables
    ``ROS_PACKAGE_PATH`` and ``AMENT_PREFIX_PATH``, and in the URDF's own folder and all above it; each may hold the
    package or be it. What is no URI is relative to the URDF's folder.

    Args:
        name: What the URDF says.
        urdf: The URDF file.
        packages: Folders that the problem names.

    Raises:
        RecipeError: It is in none of these places; with every one of them.
    """
    places = list(dict.fromkeys(_places(name, urdf.absolute(), packages)))
    found = next((place for place in places if os.path.isfile(place)), None)  # noqa: PTH113 - takes names of any length
    if found is None:
        said = (
            "\n".join(f"  {str(place)[:LONGEST]}" for place in places)
            or "  nowhere: a file of this kind of address is not read"
        )
        raise RecipeError([f"{urdf}: the file {show(name)} is missing; looked for at\n{said}{_hint(name)}"])
    return found


def _places(name: str, urdf: Path, packages: Sequence[Path]) -> Iterator[Path]:
    """List where a file could be, the likeliest first."""
    parts = urlparse(name)
    if parts.scheme in _PACKAGE:
        package, rest = unquote(parts.netloc), unquote(parts.path).lstrip("/")
        for folder in (*packages, *_of_environment(), *urdf.parents):
            yield folder / package / rest
            if folder.name == package:
                yield folder / rest
    elif parts.scheme == "file":
        yield Path(unquote(parts.path))
    elif not parts.scheme:
        yield urdf.parent / name


def _of_environment() -> Iterator[Path]:
    """List the folders of packages that ROS's environment variables name."""
    for variable in _SEARCHED:
        for folder in filter(None, os.environ.get(variable, "").split(os.pathsep)):
            yield Path(folder) / "share" if variable == "AMENT_PREFIX_PATH" else Path(folder)


def _hint(name: str) -> str:
    if urlparse(name).scheme not in _PACKAGE:
        return ""
    return f"\nname a folder that holds the package as 'packages' in [robot], or in {' or '.join(_SEARCHED)}"
