"""The machine's C compiler: which one it is, what it compiles for, and running it."""

import hashlib
import os
import platform
import shlex
import shutil
import signal
import subprocess
from contextlib import suppress
from functools import cache
from pathlib import Path

from cnpgen.errors import MachineError

_OPEN = ("-Wl,-undefined,dynamic_lookup",) if platform.system() == "Darwin" else ()  # call.c calls Python's functions
FLAGS = ("-std=gnu11", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared", "-w", *_OPEN)
COMPILE_SECONDS = 3600  # what takes longer hangs; the largest kernels take minutes on a busy machine
VERSION_SECONDS = 10


@cache
def find_compiler() -> str | None:
    """Return the command of the C compiler: ``$CC``, then cc, gcc, clang; None where there is none.

    It is quoted as a shell would want it: CC may be a path with spaces, or a program with options ("ccache gcc").
    """
    if wanted := os.environ.get("CC"):
        return _command([wanted]) or _command(_words(wanted))
    return next((path for path in map(shutil.which, ["cc", "gcc", "clang"]) if path), None)


def _words(command: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError:  # a quotation mark is not closed
        return []


def _command(words: list[str]) -> str | None:
    """Return a command with the path of its program, or None if there is no such program."""
    path = shutil.which(words[0]) if words else None
    return shlex.join([path, *words[1:]]) if path else None


def require_compiler() -> str:
    """Return the command of the C compiler.

    Raises:
        MachineError: There is none.
    """
    if compiler := find_compiler():
        return compiler
    if wanted := os.environ.get("CC"):
        raise MachineError(f"no C compiler found: CC is {wanted!r}, which names no program here (set or unset it)")
    raise MachineError("no C compiler found (looked for cc, gcc, clang): install gcc or clang")


@cache
def compiler_version(compiler: str) -> str:
    """Return the first line of ``compiler --version``.

    Raises:
        MachineError: The compiler does not run.
    """
    done = _run([*shlex.split(compiler), "--version"], VERSION_SECONDS, "to say its version")
    if done.returncode != 0:
        raise MachineError(f"the C compiler {compiler} does not run: --version ends with exit code {done.returncode}")
    return done.stdout.splitlines()[0].strip() if done.stdout else "unknown"


def _run(command: list[str], seconds: float, what: str) -> "subprocess.CompletedProcess[str]":
    """Run a compiler; where it takes too long, or this process is interrupted, end it with all that it has started.

    Raises:
        MachineError: It does not run, or takes longer.
    """
    pipe = subprocess.PIPE
    try:
        process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, errors="replace", process_group=0)
    except OSError as error:
        raise MachineError(f"the C compiler {command[0]} does not run: {error}") from error
    with process:
        try:
            out, errors = process.communicate(timeout=seconds)
        except BaseException as error:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            if isinstance(error, subprocess.TimeoutExpired):
                raise MachineError(f"the C compiler {command[0]} took more than {seconds:g} s {what}") from error
            raise
    return subprocess.CompletedProcess(command, process.returncode, out, errors)


@cache
def target() -> str:
    """Name the instruction set that kernels are compiled for; machines that share a cache must not share libraries."""
    flags = ""
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        flags = next((line.split(":", 1)[1] for line in lines if line.lower().startswith(("flags", "features"))), "")
    return f"{platform.system()}-{platform.machine()}-{hashlib.sha256(flags.encode()).hexdigest()[:8]}"


def vector_flags() -> tuple[str, ...]:
    """Flags that let the compiler use this machine's vector instructions."""
    if platform.machine() in ("arm64", "aarch64"):
        return ("-mcpu=native",)
    return ("-march=native",)


def flags_of(level: str) -> tuple[str, ...]:
    """Return what kernels are compiled with, at a level of optimisation."""
    return (*FLAGS, level, *vector_flags())


def run_compiler(compiler: str, level: str, source: Path, built: Path) -> None:
    """Compile C source to a shared library.

    Raises:
        MachineError: The compiler fails, or takes more than an hour.
    """
    command = [*shlex.split(compiler), *flags_of(level), str(source), "-o", str(built), "-lm"]
    done = _run(command, COMPILE_SECONDS, f"for {source.name}")
    if done.returncode != 0 or not built.exists():
        first = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr.strip()[:200])
        raise MachineError(f"{compiler} failed with exit code {done.returncode}: {first or 'no message'}")
