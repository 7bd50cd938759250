"""The commands of the core, and those that add-ons and other packages register in the group ``cnpgen.commands``.

A command is a module with the functions of ``cnpgen.cli.parser.add_command``. An entry
point with a dot in its name, such as ``evaluate.trajectories``, is an alternative input
of a command (``cnpgen.cli.parser.Alternative``).
"""

from importlib import import_module
from types import ModuleType
from typing import Any

from cnpgen.errors import CnpgenError, MachineError
from cnpgen.schema import addons
from cnpgen.schema.registry import COMMANDS

_CORE = {  # command -> module of cnpgen.cli, in the order of the help
    "make-dataset": "make_command",
    "merge": "merge_command",
    "extend": "extend_command",
    "copy": "copy_command",
    "inspect": "inspect_command",
    "validate": "validate_command",
    "train": "train_command",
    "plan": "plan_command",
    "complete": "complete_command",
    "solve": "solve_command",
    "refine": "refine_command",
    "evaluate": "evaluate_command",
    "export": "export_command",
    "doctor": "doctor_command",
    "docs": "docs_command",
}


def command_names() -> list[str]:
    """List the commands: those of the core in the order of the help, then the others by name."""
    # A name with a dot is another input of a command: "evaluate.trajectories".
    others = {
        entry.name for entry in addons.installed(COMMANDS) if "." not in entry.name
    }
    return [*_CORE, *sorted(others - _CORE.keys())]


def is_command(name: str) -> bool:
    """Return whether a word is a command, also one of a missing add-on.

    The core's need no metadata of packages.
    """
    return name in _CORE or (
        "." not in name and addons.find(COMMANDS, name) is not None
    )


def load_command(name: str) -> ModuleType:
    """Import the module of a command.

    Raises:
        MissingAddonError: The command belongs to an add-on that this installation
            lacks.
        MachineError: The module of another package cannot be imported.
    """
    if name in _CORE:
        return import_module(f"cnpgen.cli.{_CORE[name]}")
    entry = addons.find(COMMANDS, name)
    assert entry is not None, name
    try:
        module: ModuleType = addons.load_entry(entry, f"the command {name!r}")
    except CnpgenError:
        raise
    except Exception as error:
        # Modules of packages may raise any exception.
        text = f"{type(error).__name__}: {error}"
        raise MachineError(
            f"the command {name!r} cannot be imported: {text}"
        ) from error
    return module


def load_alternatives(name: str) -> list[Any]:
    """Import the alternative inputs of a command."""
    entries = [
        entry
        for entry in addons.installed(COMMANDS)
        if entry.name.startswith(f"{name}.")
    ]
    return [addons.load_entry(entry, f"the command {name!r}") for entry in entries]
