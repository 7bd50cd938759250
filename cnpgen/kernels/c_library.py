"""Handwritten C, compiled once with the C compiler of the machine and cached by content."""

import ctypes
import hashlib
import logging
import shlex
import tempfile
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from cnpgen.errors import MachineError
from cnpgen.kernels.compiler import (
    compiler_version,
    flags_of,
    require_compiler,
    run_compiler,
    target,
)
from cnpgen.kernels.emit import prelude
from cnpgen.store.files.cache_folder import (
    LIBRARIES,
    exclusive_lock,
    is_trusted,
    make_private_folder,
    make_read_only_for_others,
    read_only_cache,
    require_trusted,
)

LEVEL = "-O3"
_LOG = logging.getLogger(__name__)


@cache
def load_library(paths: tuple[Path, ...], cache_folder: Path) -> ctypes.CDLL | None:
    """Return the library of C source, compiled if the cache lacks it; None, after a warning, if that fails."""
    try:
        return ctypes.CDLL(str(compile_source(paths, cache_folder)))
    except (MachineError, OSError) as error:
        text = (
            f"{error}; {paths[-1].stem} runs in NumPy, which is slower"
            " ('cnpgen docs troubleshooting')"
        )
        warnings.warn(text, RuntimeWarning, stacklevel=3)
        return None


def library_file_stem(name: str, source: str, compiler: str) -> str:
    """Return the stem of the library's file name, which contains a digest of all inputs of the compilation."""
    identity = hashlib.sha256(source.encode())
    flags = (*flags_of(LEVEL), *shlex.split(compiler)[1:])
    for text in (*flags, compiler_version(compiler), target()):
        identity.update(text.encode() + b"\0")
    return f"{name}-{identity.hexdigest()[:24]}"


def find_library(folder: Path, stem: str) -> Path | None:
    """Return a trusted library whose content has the digest in its file name, or None.

    Loading a damaged library would crash the process.
    """
    libraries = (path for path in folder.glob(f"{stem}-*.so") if is_trusted(path))
    return next(
        (path for path in libraries if path.stem == f"{stem}-{_content_digest(path)}"),
        None,
    )


def _content_digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:24]


def _find(stem: str, cache_folder: Path) -> Path | None:
    try:
        libraries = (
            find_library(folder / LIBRARIES, stem)
            for folder in require_trusted(cache_folder)
        )
        return next((library for library in libraries if library), None)
    except OSError as error:
        raise _unusable(cache_folder, error) from error


def compile_source(paths: Sequence[Path], cache_folder: Path) -> Path:
    """Return the library of C source that uses the double vectors of ``vectors.h``.

    The files are concatenated in their order; the last one names the library. A library
    that the cache lacks, or whose copy is damaged, is compiled.

    Raises:
        MachineError: There is no working compiler, or the cache folder is not writable
            or writable for other users.
    """
    parts = [prelude("float64"), *(path.read_text(encoding="utf-8") for path in paths)]
    text = "".join(parts)
    stem = library_file_stem(paths[-1].stem, text, require_compiler())
    if library := _find(stem, cache_folder):
        return library
    libraries = cache_folder / LIBRARIES
    try:
        make_private_folder(libraries)
        require_trusted(cache_folder)
        with exclusive_lock(
            libraries / f".{stem}.lock"
        ):  # another process may have compiled it meanwhile
            return find_library(libraries, stem) or _build(stem, text, cache_folder)
    except OSError as error:
        raise _unusable(cache_folder, error) from error


def _build(stem: str, source: str, cache_folder: Path) -> Path:
    libraries = cache_folder / LIBRARIES
    if linked := read_only_cache(cache_folder):
        _LOG.info(
            "compiling C code for this run only: the cache %s lacks it and is not writable",
            linked,
        )
    else:
        _LOG.info("compiling C code, once per machine")
    with tempfile.TemporaryDirectory(dir=libraries, prefix=".build-") as folder:
        source_file, built = (
            Path(folder) / f"{stem.rpartition('-')[0]}.c",
            Path(folder) / "kernel.so",
        )
        source_file.write_text(source, encoding="utf-8")
        run_compiler(require_compiler(), LEVEL, source_file, built)
        make_read_only_for_others(built)
        return built.replace(libraries / f"{stem}-{_content_digest(built)}.so")


def _unusable(cache_folder: Path, error: OSError) -> MachineError:
    return MachineError(
        f"cannot use the kernel cache {cache_folder / LIBRARIES}: {error.strerror or error}"
    )
