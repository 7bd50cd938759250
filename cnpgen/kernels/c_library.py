"""Handwritten C: libraries that the package has, or else libraries compiled once per machine and cached by content.

The build of the package compiles the libraries for every variant of the processor (``hatch_build.py``);
the digest in the name of a file makes sure that it belongs to the present sources. All variants, and a
library that this machine compiles, give results of equal bits. Only the standard library is imported here.
"""

import ctypes
import hashlib
import logging
import platform
import shlex
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

from cnpgen.errors import MachineError
from cnpgen.kernels.compiler import (
    COMPILER_FLAGS,
    compiler_version,
    native_flags,
    require_compiler,
    run_compiler,
    target,
)
from cnpgen.machine.versions import processor_entry
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
VECTORS, ARRAYS = (Path(__file__).with_name(name) for name in ("vectors.h", "arrays.h"))
BUILT_FOLDER = Path(__file__).with_name("built")
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Variant:
    """Instruction sets that a library of the package is compiled for.

    Attributes:
        name: The compiler's name of the processor, the value of ``-march``.
        zig: The name of ziglang, the value of ``-mcpu``.
        features: Names in Linux of the instruction sets that a processor must have.
    """

    name: str
    zig: str
    features: frozenset[str] = frozenset()

    def flag(self, compiler: str) -> str:
        """Return the option of a compiler."""
        is_zig = "ziglang" in shlex.split(compiler)
        return f"-mcpu={self.zig}" if is_zig else f"-march={self.name}"


_AVX2 = frozenset({"avx2", "fma", "bmi1", "bmi2", "f16c", "abm", "movbe"})
_AVX512 = frozenset({f"avx512{part}" for part in ("f", "bw", "cd", "dq", "vl")})
VARIANTS = {  # of each architecture, the fastest first
    "x86_64": (
        Variant("x86-64-v4", "x86_64_v4", _AVX2 | _AVX512),
        Variant("x86-64-v3", "x86_64_v3", _AVX2),
        Variant("x86-64", "x86_64"),
    ),
    "aarch64": (Variant("armv8-a", "generic"),),
    "arm64": (Variant("armv8-a", "generic"),),
}


def source_text(paths: Sequence[Path]) -> str:
    """Return C source that uses the double vectors of ``vectors.h``, the files in their order."""
    return "".join(path.read_text(encoding="utf-8") for path in (VECTORS, *paths))


def built_file_name(paths: Sequence[Path], variant: Variant) -> str:
    """Return the name of a library of the package, which contains a digest of its source and flags."""
    parts = source_text(paths), *COMPILER_FLAGS, LEVEL, variant.name
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]
    return f"{paths[-1].stem}-{variant.name}-{digest}.so"


def build_libraries(libraries: Sequence[Sequence[Path]], folder: Path) -> list[Path]:
    """Compile libraries for all variants of this architecture into a folder; return the files.

    Libraries that the folder has are not compiled again.

    Raises:
        MachineError: There is no working compiler.
    """
    built = []
    for paths, variant in product(libraries, VARIANTS.get(platform.machine(), ())):
        file = folder / built_file_name(paths, variant)
        if not file.exists():
            with tempfile.TemporaryDirectory(dir=folder, prefix=".build-") as scratch:
                source = Path(scratch) / paths[-1].name
                source.write_text(source_text(paths), encoding="utf-8")
                library = source.with_suffix(".so")
                compiler = require_compiler()
                flags = LEVEL, variant.flag(compiler)
                run_compiler(compiler, flags, source, library)
                library.replace(file)
        built.append(file)
    return built


@cache
def this_variants() -> tuple[Variant, ...]:
    """Return the variants that this processor can run, the fastest first."""
    features = set(processor_entry("flags", "features").split())
    variants = VARIANTS.get(platform.machine(), ())
    return tuple(variant for variant in variants if variant.features <= features)


def find_built(paths: Sequence[Path]) -> Path | None:
    """Return the fastest library of the package for a source and this processor, or None."""
    if not BUILT_FOLDER.is_dir():
        return None
    files = (BUILT_FOLDER / built_file_name(paths, one) for one in this_variants())
    return next((file for file in files if file.is_file()), None)


@cache
def load_library(paths: tuple[Path, ...], cache_folder: Path) -> ctypes.CDLL:
    """Return the library of C source: that of the package, or else one from the cache.

    It is compiled if the cache lacks it.

    Raises:
        MachineError: There is no library of the package, and the compilation fails.
    """
    if built := find_built(paths):
        # Of another C library than the one of this system.
        with suppress(OSError):
            return ctypes.CDLL(str(built))
    try:
        return ctypes.CDLL(str(compile_source(paths, cache_folder)))
    except (MachineError, OSError) as error:
        raise MachineError(
            f"the compiled C code {paths[-1].stem} is missing: {error}"
            " ('cnpgen docs troubleshooting')"
        ) from error


def library_file_stem(name: str, source: str, compiler: str) -> str:
    """Return the stem of the library's file name, which contains a digest of all inputs of the compilation."""
    identity = hashlib.sha256(source.encode())
    flags = (*COMPILER_FLAGS, LEVEL, *native_flags(), *shlex.split(compiler)[1:])
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
    """Return the library of C source from the cache; see ``source_text``. The last file names it.

    A library that the cache lacks, or whose copy is damaged, is compiled.

    Raises:
        MachineError: There is no working compiler, or the cache folder is not writable
            or writable for other users.
    """
    text = source_text(paths)
    stem = library_file_stem(paths[-1].stem, text, require_compiler())
    if library := _find(stem, cache_folder):
        return library
    libraries = cache_folder / LIBRARIES
    try:
        make_private_folder(libraries)
        require_trusted(cache_folder)
        # Another process may have compiled it meanwhile.
        with exclusive_lock(libraries / f".{stem}.lock"):
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
        source_file = Path(folder) / f"{stem.rpartition('-')[0]}.c"
        built = Path(folder) / "kernel.so"
        source_file.write_text(source, encoding="utf-8")
        flags = (LEVEL, *native_flags())
        run_compiler(require_compiler(), flags, source_file, built)
        make_read_only_for_others(built)
        return built.replace(libraries / f"{stem}-{_content_digest(built)}.so")


def _unusable(cache_folder: Path, error: OSError) -> MachineError:
    return MachineError(
        f"cannot use the kernel cache {cache_folder / LIBRARIES}: {error.strerror or error}"
    )
