"""The C compiler of the machine: its command, version, target and flags."""

import hashlib
import logging
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cnpgen.errors import MachineError
from cnpgen.machine.versions import processor_entry
from cnpgen.store.files.cache_folder import default_cache_folder, temporary_folder

# For Python's C API.
_LINKER_FLAGS = (
    ("-Wl,-undefined,dynamic_lookup",) if platform.system() == "Darwin" else ()
)
COMPILER_FLAGS = (  # no contraction to fused operations: equal bits on all processors
    "-std=gnu11", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared", "-w",
    *_LINKER_FLAGS,
)  # fmt: skip
# The largest kernels, of some MB of source, take minutes on a busy machine.
MAX_COMPILE_TIME_S = 3600
# The limit for the smallest kernels, which take less than 1 s.
MIN_COMPILE_LIMIT_S = 120
LIMIT_S_PER_BYTE = 3e-3  # of source
MAX_VERSION_TIME_S = 10
NOTICE_AFTER_S = 60  # a user hears of a compiler that takes longer
_LOG = logging.getLogger(__name__)


@cache
def find_compiler() -> str | None:
    """Return the command of the C compiler: ``$CC``, else cc, gcc, clang or that of ziglang; None if there is none.

    It is quoted for a shell: CC may be a path with spaces, or a program with options
        ("ccache gcc").
    """
    if configured := os.environ.get("CC"):
        return _command([configured]) or _command(_words(configured))
    if path := next(filter(None, map(shutil.which, ["cc", "gcc", "clang"])), None):
        return path
    return (
        shlex.join([sys.executable, "-m", "ziglang", "cc"])
        if sys.executable and find_spec("ziglang")
        else None
    )


def _words(command: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError:
        # A quotation mark is not closed.
        return []


def _command(words: list[str]) -> str | None:
    """Return a command with the full path of its program, or None if the program does not exist."""
    path = shutil.which(words[0]) if words else None
    return shlex.join([path, *words[1:]]) if path else None


def require_compiler() -> str:
    """Return the command of the C compiler.

    Raises:
        MachineError: There is none.
    """
    if compiler := find_compiler():
        return compiler
    if configured := os.environ.get("CC"):
        raise MachineError(
            f"no C compiler found: CC is {configured!r}, which names no program here (set or unset it)"
        )
    raise MachineError(
        "no C compiler found (no cc, gcc or clang): install one, or pip install 'cnpgen[compiler]'"
    )


@cache
def compiler_version(compiler: str) -> str:
    """Return the first line of ``compiler --version``.

    Raises:
        MachineError: The compiler does not run.
    """
    completed = _run(
        compiler, ["--version"], MAX_VERSION_TIME_S, "to print its version"
    )
    if completed.returncode != 0:
        raise MachineError(
            f"the C compiler {compiler} does not run: --version ends with exit code {completed.returncode}"
        )
    return completed.stdout.splitlines()[0].strip() if completed.stdout else "unknown"


def _zig_folder() -> Path:
    """Return a folder for files of ziglang, which does not end if it cannot write to its own one in the home folder."""
    folder = default_cache_folder()
    return folder / "ziglang" if os.access(folder, os.W_OK) else _temporary_folder()


@cache
def _temporary_folder() -> Path:
    return temporary_folder()


def _run(
    compiler: str, options: list[str], seconds: float, purpose: str
) -> "subprocess.CompletedProcess[str]":
    """Run a compiler; at the time limit, or if this process is interrupted, kill it and its child processes.

    Raises:
        MachineError: It does not run, or exceeds the time limit.
    """
    command = [*shlex.split(compiler), *options]
    pipe = subprocess.PIPE
    variables = dict(os.environ)
    if "ziglang" in command:
        variables.setdefault("ZIG_GLOBAL_CACHE_DIR", str(_zig_folder()))
    texts: dict[str, Any] = {
        "stdout": pipe,
        "stderr": pipe,
        "text": True,
        "errors": "replace",
    }
    try:
        # A compiler that reads a terminal would be stopped.
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, process_group=0, env=variables, **texts
        )
    except OSError as error:
        raise MachineError(
            f"the C compiler {compiler} does not run: {error}"
        ) from error
    with process:
        try:
            out, errors = _outputs(process, compiler, seconds, purpose)
        except BaseException as error:
            _kill(process)
            if isinstance(error, subprocess.TimeoutExpired):
                hint = "set CC to another compiler"
                raise MachineError(
                    f"the C compiler {compiler} took more than {seconds:g} s {purpose}: {hint}"
                ) from error
            raise
    return subprocess.CompletedProcess(command, process.returncode, out, errors)


def _outputs(
    process: "subprocess.Popen[str]", name: str, seconds: float, purpose: str
) -> tuple[str, str]:
    """Wait for a compiler and return its output; log a notice if it takes long."""
    try:
        return process.communicate(timeout=min(NOTICE_AFTER_S, seconds))
    except subprocess.TimeoutExpired:
        if seconds <= NOTICE_AFTER_S:
            raise
    _LOG.info(
        "the C compiler %s has taken %g s %s; it is ended after %g s",
        name,
        NOTICE_AFTER_S,
        purpose,
        seconds,
    )
    return process.communicate(timeout=seconds - NOTICE_AFTER_S)


def _kill(process: "subprocess.Popen[str]") -> None:
    with suppress(ProcessLookupError):
        # The compiler leads a process group of its own, which contains its child
        # processes.
        os.killpg(process.pid, signal.SIGKILL)


@cache
def target() -> str:
    """Return a name of the instruction set that kernels are compiled for, so that a cache may be shared by machines."""
    flags = processor_entry("flags", "features")
    return f"{platform.system()}-{platform.machine()}-{hashlib.sha256(flags.encode()).hexdigest()[:8]}"


def native_flags() -> tuple[str, ...]:
    """Return the flags for the vector instructions of this machine."""
    return (
        "-mcpu=native"
        if platform.machine() in ("arm64", "aarch64")
        else "-march=native",
    )


def run_compiler(
    compiler: str, flags: tuple[str, ...], source: Path, built: Path
) -> None:
    """Compile C source to a shared library with ``COMPILER_FLAGS`` and further flags.

    Raises:
        MachineError: The compiler fails, or takes too long for the size of the source.
    """
    options = [*COMPILER_FLAGS, *flags, str(source), "-o", str(built), "-lm"]
    # The limit grows with the size of the source, between that of the smallest and
    # largest.
    seconds = min(
        MIN_COMPILE_LIMIT_S + round(LIMIT_S_PER_BYTE * source.stat().st_size),
        MAX_COMPILE_TIME_S,
    )
    completed = _run(compiler, options, seconds, f"for {source.name}")
    if completed.returncode != 0 or not built.exists():
        errors = completed.stderr
        # The first line about an error, or else the beginning of the output.
        first = next(
            (line for line in errors.splitlines() if "error" in line),
            errors.strip()[:200],
        )
        raise MachineError(
            f"{compiler} failed with exit code {completed.returncode}: {first or 'no message'}"
        )
