"""Search of URDFs in packages, and of the files that a URDF refers to, mostly meshes."""

import os
from collections.abc import Iterable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from urllib.parse import unquote, urlparse

from cnpgen.errors import PluginError, RecipeError
from cnpgen.schema.catalogue import MAX_NAME_LENGTH
from cnpgen.schema.units import show

_PACKAGE = ("package", "model")  # URI schemes that begin with the name of a package
_SEARCHED = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
MAX_PACKAGE_DEPTH = 3  # folders above a URDF that may be its package under another name
# Python packages of robots -> cnpgen's extra that installs them
_EXTRAS = {"example-robot-data": "robots"}


def find_urdf(name: str, problem: Path, packages: Sequence[Path] = ()) -> Path:
    """Find the URDF of a problem, in a package (see ``find_named_file``) or relative to the problem file."""
    if urlparse(name).scheme not in _PACKAGE:
        return problem.parent / name
    try:
        return _find(name, problem, packages)
    except RecipeError as error:
        raise PluginError(error.errors) from None


def find_named_file(name: str, urdf: Path, packages: Sequence[Path] = ()) -> Path:
    """Find a file that a URDF refers to.

    ``package://NAME/REST`` is looked for in the folders of ``packages``, in those of
    the environment variables ``ROS_PACKAGE_PATH`` and ``AMENT_PREFIX_PATH``, in the
    URDF's own folder and all above it, and where pip installs a package of this name;
    each may hold the package or be it. Finally the folders around the URDF are taken
    for the package, whose folder may have another name. What is no URI is relative to
    the URDF's folder.
    """
    try:
        return _find(name, urdf, packages)
    except RecipeError as error:
        raise RecipeError([f"{urdf}: {error}" for error in error.errors]) from None


def packages_of_environment(
    names: Iterable[str], urdf: Path, packages: Sequence[Path] = ()
) -> tuple[Path, ...]:
    """List the folders from environment variables with packages of file names in a URDF; others are ignored."""
    used = []
    for name in (each for each in names if urlparse(each).scheme in _PACKAGE):
        place = _first(_places(name, urdf.absolute(), packages))
        if place is not None and not any(map(place.is_relative_to, packages)):
            used += [
                folder for folder in _of_environment() if place.is_relative_to(folder)
            ][:1]
    return tuple(dict.fromkeys(used))


def _find(name: str, beside: Path, packages: Sequence[Path]) -> Path:
    places = list(dict.fromkeys(_places(name, beside.absolute(), packages)))
    found = _first(places)
    if found is None:
        none = "  none: this kind of address is not read"
        searched = (
            "\n".join(f"  {str(place)[:MAX_NAME_LENGTH]}" for place in places) or none
        )
        raise RecipeError(
            [
                f"the file {show(name)} is missing; searched paths:\n{searched}{_hint(name)}"
            ]
        )
    return found


def _first(places: Iterable[Path]) -> Path | None:
    return next((place for place in places if os.path.isfile(place)), None)  # noqa: PTH113 - takes names of any length


def _places(name: str, beside: Path, packages: Sequence[Path]) -> Iterator[Path]:
    """List the candidate paths of a referenced file, the most likely first."""
    parts = urlparse(name)
    if parts.scheme in _PACKAGE:
        package = unquote(parts.netloc)
        rest = unquote(parts.path).lstrip("/")
        for folder in (
            *packages,
            *_of_environment(),
            *beside.parents,
            *_of_distribution(package),
        ):
            yield folder / package / rest
            if folder.name == package:
                yield folder / rest
        # The package under another name.
        for folder in list(beside.parents)[:MAX_PACKAGE_DEPTH]:
            yield folder / rest
    elif parts.scheme == "file":
        yield Path(unquote(parts.path))
    elif not parts.scheme:
        yield beside.parent / name


def _of_environment() -> Iterator[Path]:
    """List the package folders of ROS's environment variables."""
    for variable in _SEARCHED:
        for folder in filter(None, os.environ.get(variable, "").split(os.pathsep)):
            yield (
                Path(folder) / "share"
                if variable == "AMENT_PREFIX_PATH"
                else Path(folder)
            )


def _of_distribution(name: str) -> Iterator[Path]:
    """List the data folders of an installed Python package."""
    try:
        installed = metadata.distribution(name)
    except (metadata.PackageNotFoundError, ValueError):
        return
    # The first one is used by packages of Pinocchio.
    for folder in (
        "cmeel.prefix/share",
        "share",
        "",
    ):
        yield Path(str(installed.locate_file(folder)))


def _hint(name: str) -> str:
    parts = urlparse(name)
    if parts.scheme not in _PACKAGE:
        return ""
    if extra := _EXTRAS.get(parts.netloc):
        return f"\nrobots of this package come with pip install 'cnpgen[{extra}]'"
    places = " or ".join(_SEARCHED)
    return f"\nname a folder that holds the package as 'packages' in [robot] (--packages of 'cnpgen init'), or in {places}"
