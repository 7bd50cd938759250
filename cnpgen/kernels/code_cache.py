"""Cache of machine code: one file per content, with a checksum; and requests for final code.

A kernel of more than ``MAX_DIRECT`` instructions gets code of the first level at once. Its
tape is stored as a request, and a detached process (``optimizer``) turns requests into final
code. It goes on when the command that asked for it has ended. Requests that it leaves
behind, because the machine was switched off, are taken up by the next command that loads
such a kernel.
"""

import hashlib
import logging
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

from cnpgen.errors import MachineError
from cnpgen.kernels.llvm_module import module_text
from cnpgen.kernels.machine_code import (
    FINAL,
    FIRST,
    LoadedCode,
    generate,
    generator_digest,
    load,
    this_processor,
)
from cnpgen.kernels.tape import Tape
from cnpgen.store.files.atomic import write_file
from cnpgen.store.files.cache_folder import (
    LIBRARIES,
    is_trusted,
    make_private_folder,
    make_read_only_for_others,
    read_only_cache,
    require_trusted,
)

MAX_DIRECT = (
    1000  # instructions of kernels that get final code at once, in at most 0.1 s
)
DIGEST_BYTES = 32
CODE = ".o"
REQUEST = ".tape"
_LOG = logging.getLogger(__name__)
_loaded: dict[tuple[Path, str], LoadedCode] = {}  # final code of this process


def content_key(content: bytes) -> str:
    """Return the name of machine code: a digest of its content, the generator and the processor."""
    return hashlib.sha256(generator_digest().encode() + content).hexdigest()[:32]


def tape_key(tape: Tape) -> str:
    """Return the name of a tape's machine code; tapes that differ in their name only share it."""
    return content_key(replace(tape, name="").to_bytes())


def final_text(tape: Tape) -> str:
    """Return the LLVM IR of a tape's final code."""
    return module_text(tape, this_processor().vector_bytes)


def find_final(key: str, cache_folder: Path) -> LoadedCode | None:
    """Return final code from this process or the cache, or None.

    Raises:
        MachineError: Other users may change files of the cache.
    """
    place = cache_folder, key
    if place not in _loaded and (code := _read(key, cache_folder)) is not None:
        _loaded[place] = load(code)
    return _loaded.get(place)


def make_final(key: str, text: str, cache_folder: Path) -> LoadedCode:
    """Return final code: loaded, from the cache, or generated and stored."""
    if (code := find_final(key, cache_folder)) is None:
        content = generate(text, FINAL)
        store(key, content, cache_folder)
        code = _loaded[cache_folder, key] = load(content)
    return code


@cache
def note_generation(cache_folder: Path) -> None:
    """Log once per process that kernels are generated."""
    if linked := read_only_cache(cache_folder):
        _LOG.info(
            "generating kernels for this run only: the cache %s lacks them and is not writable",
            linked,
        )
    else:
        _LOG.info("generating kernels, once per problem and machine")


def make_first(tape: Tape) -> LoadedCode:
    """Return code of the first level with a dispatcher; see ``llvm_module.module_text``."""
    text = module_text(tape, this_processor().vector_bytes, replaceable=True)
    return load(generate(text, FIRST))


def store(key: str, code: bytes, cache_folder: Path) -> bool:
    """Write code to the cache with its checksum; return False if that is impossible, which only costs time."""
    return _write(_path(cache_folder, key + CODE), hashlib.sha256(code).digest() + code)


def request_final(key: str, tape: Tape, cache_folder: Path) -> Path | None:
    """Write a request for final code; return its path, or None if the cache cannot be written."""
    path = _path(cache_folder, key + REQUEST)
    return path if path.exists() or _write(path, tape.to_bytes()) else None


def _path(cache_folder: Path, name: str) -> Path:
    return cache_folder / LIBRARIES / name


def _write(path: Path, content: bytes) -> bool:
    with suppress(MachineError, OSError):
        make_private_folder(path.parent)
        write_file(path, content)
        make_read_only_for_others(path)
        return True
    return False


def _read(key: str, cache_folder: Path) -> bytes | None:
    """Return code from the cache, or None; damaged and untrusted files are ignored."""
    for folder in require_trusted(cache_folder):
        path = _path(folder, key + CODE)
        with suppress(OSError):
            content = path.read_bytes() if is_trusted(path) else b""
            code = content[DIGEST_BYTES:]
            # The checksum comes before the code; see ``store``.
            if code and hashlib.sha256(code).digest() == content[:DIGEST_BYTES]:
                return code
    return None
