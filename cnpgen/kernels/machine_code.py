"""Machine code of LLVM IR by llvmlite: its processor, generation at a level, and loading.

LLVM is imported when the first kernel is made or loaded.
"""

import ctypes
import hashlib
import os
import threading
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from cnpgen.errors import MachineError

# Levels: generated ten times faster; as fast as an optimizing compiler's code.
FIRST = 0
FINAL = 1
SOURCES = (
    "steps",
    "lowering",
    "vector_functions",
    "llvm_text",
    "llvm_module",
    "machine_code",
)
# Owners of all loaded code, whose addresses other code may have.
_engines: list[Any] = []
LOCK = threading.RLock()  # around every call of LLVM, also of other threads at a fork

os.register_at_fork(
    before=LOCK.acquire, after_in_parent=LOCK.release, after_in_child=LOCK.release
)


@dataclass(frozen=True)
class Processor:
    """The processor that code is generated for.

    Attributes:
        triple: LLVM's name of architecture and system.
        name: LLVM's name of the model.
        features: Its instruction sets, in LLVM's notation.
    """

    triple: str
    name: str
    features: str

    @property
    def vector_bytes(self) -> int:
        """Size of a vector register."""
        sets = set(self.features.split(","))
        return 64 if "+avx512f" in sets else 32 if "+avx" in sets else 16


@dataclass(frozen=True)
class LoadedCode:
    """Machine code in memory; it stays there as long as the process runs.

    Attributes:
        engine: LLVM's owner of the memory.
    """

    engine: Any

    def address(self, function: str) -> int:
        """Return the address of a function or a variable."""
        with LOCK:
            return int(
                self.engine.get_function_address(function)
                or self.engine.get_global_value_address(function)
            )


@cache
def _llvm() -> Any:
    """Return llvmlite's binding, ready for this processor.

    Raises:
        MachineError: llvmlite is missing or broken.
    """
    try:
        from llvmlite import binding

        binding.initialize_native_target()
        binding.initialize_native_asmprinter()
    except (ImportError, OSError, AttributeError, RuntimeError) as error:
        raise MachineError(
            f"LLVM cannot be loaded ({error}): reinstall it by 'pip install --force-reinstall llvmlite'"
        ) from error
    return binding


@cache
def this_processor() -> Processor:
    """Return the processor of this machine."""
    with LOCK:
        llvm = _llvm()
        features = llvm.get_host_cpu_features().flatten()
        return Processor(llvm.get_default_triple(), llvm.get_host_cpu_name(), features)


def generator_version() -> str:
    """Return the versions of llvmlite and LLVM."""
    import llvmlite

    numbers = ".".join(map(str, _llvm().llvm_version_info))
    return f"llvmlite {llvmlite.__version__}, LLVM {numbers}"


@cache
def generator_digest() -> str:
    """Return a digest of everything but the tape that machine code depends on."""
    digest = hashlib.sha256()
    # A change of the generator's source, of LLVM or of the processor must not find old
    # code.
    for name in SOURCES:
        digest.update(Path(__file__).with_name(f"{name}.py").read_bytes())
    digest.update(f"{generator_version()} {this_processor()}".encode())
    return digest.hexdigest()


def set_background_options() -> None:
    """Set LLVM's options of a process that only optimizes kernels.

    The scheduler of machine instructions is switched off: in kernels of 30,000
    operations it takes 40 % of the time, and the longer lives of values cost registers.
    """
    with LOCK:
        _llvm().set_option("cnpgen", "-enable-misched=false")


def generate(text: str, level: int, processor: Processor | None = None) -> bytes:
    """Return the object file of LLVM IR.

    Raises:
        MachineError: LLVM refuses the IR or the processor.
    """
    processor = processor or this_processor()
    with LOCK:
        llvm = _llvm()
        try:
            module = llvm.parse_assembly(text)
            machine = llvm.Target.from_triple(processor.triple).create_target_machine(
                cpu=processor.name, features=processor.features, opt=level
            )
            return bytes(machine.emit_object(module))
        except RuntimeError as error:
            raise MachineError(f"LLVM cannot generate a kernel: {error}") from error


def load(code: bytes) -> LoadedCode:
    """Load an object file that ``generate`` made for this processor; LLVM crashes on any other content.

    Raises:
        MachineError: LLVM cannot load it.
    """
    with LOCK:
        llvm = _llvm()
        try:
            # An empty module: the object file alone is linked.
            target = llvm.Target.from_triple(this_processor().triple)
            engine = llvm.create_mcjit_compiler(
                llvm.parse_assembly(""), target.create_target_machine()
            )
            engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(code))
            engine.finalize_object()
        except RuntimeError as error:
            raise MachineError(f"LLVM cannot load a kernel: {error}") from error
        _engines.append(engine)
        return LoadedCode(engine)


def define_symbol(name: str, function: Any) -> None:
    """Make a function of C known to code that is loaded later."""
    with LOCK:
        address = ctypes.cast(function, ctypes.c_void_p).value
        _llvm().add_symbol(name, address)
