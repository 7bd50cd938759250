"""Files and folders of scenes: the formats by their content, and the writers by the suffix."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from cnpgen.addons.scene_files.moveit_meshes import warn_of_unneeded_packages
from cnpgen.addons.scene_files.moveit_scenes import is_moveit, read_moveit
from cnpgen.addons.scene_files.moveit_writer import check_plain, moveit_texts
from cnpgen.addons.scene_files.mpinets_scenes import (
    is_mpinets,
    mpinets_bytes,
    read_mpinets,
)
from cnpgen.addons.scene_files.robometrics_scenes import (
    is_robometrics,
    read_robometrics,
)
from cnpgen.documents import AnyPath, JsonObject, NamedNumbers
from cnpgen.errors import UsageError, listed
from cnpgen.problems.scenes.scene_problem import (
    MAX_SCENES,
    SceneError,
    SceneProblem,
    check_scenes,
    checked_scene,
)
from cnpgen.problems.scenes.scene_reader import ReadingOptions
from cnpgen.problems.scenes.yaml_document import read_yaml
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer
from cnpgen.store.files.accounted import Account, check_allowed
from cnpgen.store.files.atomic import write_file
from cnpgen.store.files.kind import HDF5_SUFFIXES, is_hdf5

YAML_SUFFIXES = (".yaml", ".yml")
SCENE_SUFFIXES = (*YAML_SUFFIXES, *HDF5_SUFFIXES)
MAX_SCENE_FILES = 20_000  # of a folder

_LOG = logging.getLogger(__name__)


@checked_arguments
def load_scenes(
    path: AnyPath,
    *,
    start: int = 0,
    n: int | None = None,
    allow_unused: Sequence[str] = (),
    packages: Sequence[AnyPath] = (),
    present: NamedNumbers | None = None,
    allowed_elsewhere: Sequence[str] = (),
) -> list[SceneProblem]:
    """Read the planning problems of scene files.

    The format follows from the content: MoveIt planning scenes and requests, or
    robometrics, in YAML; MPiNets or Avoid Everything in HDF5. Files of a folder are
    read in the order of their names, without subfolders. Every element of a file is
    used, refused by name, or cannot change the answer; those of other software are
    listed by the logger ``cnpgen``.

    Args:
        path: A file, or a folder of files.
        start: First scene.
        n: Number of scenes; by default all that follow.
        allow_unused: Keys, or ends of paths such as ``start_state.is_diff``, of
            elements that are accepted without effect.
        packages: Folders of the packages of MoveIt's mesh files, which are otherwise
            relative to their scene.
        present: Joint -> position [rad], the state of the robot that an empty
            ``start_state`` of MoveIt means.
        allowed_elsewhere: Further keys as ``allow_unused``, which the scenes may lack.

    Raises:
        UsageError: There are no scenes, or a key of ``allow_unused`` names no element
            that would be refused.
        SceneError: A scene is invalid; the message names file, scene and obstacle. A
            subclass of UsageError.
        DatasetError: An HDF5 file is damaged.
        MissingExtraError: PyYAML is missing.
    """
    path = Path(path)
    start = integer("start", start, least=0)
    stop = None if n is None else start + integer("n", n, least=1)
    _check_packages(packages)
    options = ReadingOptions(
        (*allow_unused, *allowed_elsewhere), tuple(map(Path, packages)), present or {}
    )
    files = _files(path)
    allowed = options.allow_unused
    if len(files) == 1 and _is_hdf5(files[0]):
        warn_of_unneeded_packages({}, options.packages)
        found = list(read_mpinets(files[0], slice(start, stop), allow_unused=allowed))
    else:
        last = stop if stop is not None else start + MAX_SCENES + 1
        found = list(itertools.islice(_scenes(files, options), start, last))
    scenes = [scene for scene, _ in found]
    _warn_of_unneeded_start(scenes, options.present)
    if len(scenes) > MAX_SCENES:
        raise SceneError(
            f"{path} has more than {MAX_SCENES:,} scenes: choose some by start and n"
        )
    if not scenes:
        raise UsageError(f"{path} has no scene from number {start} on", concerns="path")
    accounts = [account for _, account in found]
    unused = [name for each in accounts for name in (*each.unused, *each.accepted)]
    check_allowed(allow_unused, unused, set().union(*(each.keys for each in accounts)))
    _report(path, accounts)
    return [checked_scene(scene) for scene in scenes]


def _check_packages(packages: Sequence[AnyPath]) -> None:
    """Check that packages are paths of folders."""
    is_list = not isinstance(packages, str | Path)
    if not is_list or not all(isinstance(each, str | Path) for each in packages):
        raise UsageError(
            f"must be paths of folders, got {packages!r}", argument="packages"
        )
    if missing := [each for each in packages if not Path(each).is_dir()]:
        raise UsageError(
            f"must be folders, there is no {missing[0]}", argument="packages"
        )


def _warn_of_unneeded_start(
    scenes: Sequence[SceneProblem], present: NamedNumbers
) -> None:
    """Warn of a present state at which no scene starts."""
    names = tuple(present)
    positions = [*present.values()]
    if present and not any(
        scene.joint_names == names and scene.start_q.tolist() == positions
        for scene in scenes
    ):
        _LOG.warning(
            "the present state of the robot (start) is not used: no start_state of the scenes is empty"
        )


def _report(path: Path, accounts: Sequence[Account]) -> None:
    """List the elements of files that were not used, in one line for each reason."""
    unused = sorted({name for account in accounts for name in account.unused})
    accepted = sorted({name for account in accounts for name in account.accepted})
    if unused:
        _LOG.info(
            "%s: not used: %s (the reasons are in 'cnpgen docs scene-elements')",
            path,
            listed(unused),
        )
    if accepted:
        _LOG.warning("%s: accepted as unused: %s", path, listed(accepted))


def holds_scenes(path: Path) -> bool:
    """Return whether a file or a folder contains scenes, judged by suffixes and the names of HDF5 datasets."""
    if path.is_dir():
        return any(
            entry.suffix.lower() in YAML_SUFFIXES or _is_scene_hdf5(entry)
            for entry in path.iterdir()
        )
    return path.is_file() and (
        path.suffix.lower() in YAML_SUFFIXES or _is_scene_hdf5(path)
    )


def _is_hdf5(path: Path) -> bool:
    return path.suffix.lower() in HDF5_SUFFIXES


def _is_scene_hdf5(path: Path) -> bool:
    return path.is_file() and _is_hdf5(path) and is_hdf5(path) and is_mpinets(path)


def _files(path: Path) -> list[Path]:
    if not path.exists():
        raise UsageError(f"no such file or folder: {path}", concerns="path")
    if not path.is_dir():
        if path.suffix.lower() not in SCENE_SUFFIXES:
            raise UsageError(
                f"{path} must end in one of {', '.join(SCENE_SUFFIXES)}",
                concerns="path",
            )
        return [path]
    files = list(itertools.islice(path.iterdir(), MAX_SCENE_FILES + 1))
    if len(files) > MAX_SCENE_FILES:
        raise UsageError(
            f"{path} has more than {MAX_SCENE_FILES:,} files", concerns="path"
        )
    known = [file for file in sorted(files) if file.suffix.lower() in SCENE_SUFFIXES]
    if not known:
        raise UsageError(
            f"{path} contains no scenes in YAML or HDF5 files", concerns="path"
        )
    return known


def _scenes(
    files: Sequence[Path], options: ReadingOptions
) -> Iterator[tuple[SceneProblem, Account]]:
    """Yield the scenes of several files with their accounts.

    Requests of MoveIt belong to scenes in other files.
    """
    moveit = dict[Path, Any]()
    allowed = options.allow_unused
    for file in files:
        if _is_hdf5(file):
            yield from read_mpinets(file, slice(0, None), allow_unused=allowed)
            continue
        for document in (
            read_yaml(file) if len(files) > 1 else _with_partner(file, moveit)
        ):
            if is_moveit(document):
                _add(moveit, file, document)
            elif is_robometrics(document):
                yield from read_robometrics(file, document, allow_unused=allowed)
            elif len(files) == 1:
                raise SceneError(
                    f"{file} is neither a planning scene or request of MoveIt nor a robometrics file"
                )
            else:
                _LOG.warning("%s has no scene and is not used", file)
    yield from read_moveit(moveit, options)


def _with_partner(file: Path, moveit: dict[Path, Any]) -> list[Any]:
    """Read one file and, for MoveIt, the scene or request beside it."""
    for old, new in (("scene", "request"), ("request", "scene")):
        head, word, tail = file.name.rpartition(old)
        partner = file.with_name(head + new + tail)
        if word and partner.is_file():
            for document in read_yaml(partner):
                if is_moveit(document):
                    _add(moveit, partner, document)
    return read_yaml(file)


def _add(moveit: dict[Path, Any], file: Path, document: JsonObject) -> None:
    """Add a document of a file, which may have a scene and a request in two of them."""
    known = moveit.setdefault(file, {})
    if twice := sorted(known.keys() & document.keys()):
        raise SceneError(
            f"{file} has several documents with {listed(twice)}: expected one scene and one request"
        )
    known |= document


@checked_arguments
def save_scenes(
    path: AnyPath, scenes: Sequence[SceneProblem], *, joints: Sequence[str] = ()
) -> None:
    """Write scenes: one HDF5 file in the format of MPiNets, or a folder of planning scenes and requests of MoveIt.

    Args:
        path: A file that ends in .h5 or .hdf5, or a folder, which is created.
        scenes: The scenes.
        joints: Names of the joints in MoveIt's requests, for scenes without names.

    Raises:
        UsageError: There are no scenes, or the path has another suffix.
        SceneError: The format cannot represent a scene.
        MachineError: A file cannot be written.
    """
    path = Path(path)
    check_scenes(scenes)
    for scene in scenes:
        check_plain(scene)
    if _is_hdf5(path):
        write_file(path, mpinets_bytes(scenes))
        return
    if path.suffix:
        raise UsageError(
            f"{path} must end in .h5 or .hdf5, or be a folder for YAML files",
            concerns="path",
        )
    texts = []
    for scene in scenes:
        names = scene.joint_names or tuple(joints)
        if len(names) != len(scene.start_q):
            raise UsageError(
                f"must name {len(scene.start_q)} joints for {scene.place}, got {len(names)}",
                argument="joints",
            )
        texts.append(moveit_texts(scene, names))
    for index, (scene_text, request_text) in enumerate(texts, 1):
        write_file(path / f"scene{index:04d}.yaml", scene_text)
        write_file(path / f"request{index:04d}.yaml", request_text)
