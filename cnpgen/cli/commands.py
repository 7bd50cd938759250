"""The commands of the core, and those that add-ons and other packages register in the group ``cnpgen.commands``.

A command is a module with the functions of ``cnpgen.cli.parser.add_command``. An entry
point with a dot in its name, such as ``evaluate.trajectories``, is an alternative input
of a command (``cnpgen.cli.parser.Alternative``).
"""

from importlib import import_module
from types import ModuleType
from typing import Any

from cnpgen.cli.parser import Parser, add_common
from cnpgen.errors import CnpgenError, MachineError
from cnpgen.schema import addons
from cnpgen.schema.entry_points import EntryPoint, entry_points
from cnpgen.schema.registry import COMMANDS, PROJECT

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


def load_command(name: str) -> tuple[ModuleType, list[Any]]:
    """Import the module of a command and its alternative inputs.

    Raises:
        MissingAddonError: The command belongs to an add-on that this installation
            lacks.
        MachineError: The module of another package cannot be imported or has no
            options, or several packages register the name.
    """
    alternatives = [
        _load(entry, name)
        for entry in addons.installed(COMMANDS)
        if entry.name.startswith(f"{name}.")
    ]
    if name in _CORE:
        return import_module(f"cnpgen.cli.{_CORE[name]}"), alternatives
    entries = [entry for entry in entry_points()[COMMANDS] if entry.name == name]
    own = [entry for entry in entries if entry.distribution == PROJECT]
    if len(entries) > 1 and not own:
        packages = " and by ".join(entry.distribution for entry in entries)
        raise MachineError(
            f"the command {name!r} is defined more than once: by {packages}"
        )
    return _load((own or entries)[0], name), alternatives


def unused_commands() -> list[str]:
    """Return a sentence for each command of a package that has the name of one of cnpgen."""
    entries = entry_points().get(COMMANDS, ())
    own = {entry.name for entry in entries if entry.distribution == PROJECT}
    return [
        f"the command {entry.name!r} of the package {entry.distribution!r} is not used: cnpgen has one of that name"
        for entry in entries
        if entry.distribution != PROJECT and entry.name in own | _CORE.keys()
    ]


def _load(entry: EntryPoint, name: str) -> Any:
    """Import a module of a command, and try the options of another package."""
    try:
        module = addons.load_entry(entry, f"the command {name!r}")
        if entry.distribution != PROJECT:
            trial = Parser()
            add_common(trial)
            module.add_options(trial)
            _ = module.run
    except CnpgenError:
        raise
    except Exception as error:
        # Modules of packages may raise any exception.
        text = f"{type(error).__name__}: {error}"
        raise MachineError(
            f"the command {name!r} of {entry.distribution or 'an installed package'} is faulty: {text}"
        ) from error
    return module
