"""The library's messages as a shell understands them: it names arguments as Python does, and options are meant."""

import re
from collections.abc import Container

_ARGUMENT = re.compile(r"\b([a-z][a-z_]*)=(?:True\b|(\d+))?(?![\w\"'({\[.])")
_CALLED = {"discard": "force", "other": "other_rows"}  # arguments whose options have another name


def in_shell(text: str, options: Container[str]) -> str:
    """Write the arguments that a message names as options: ``force=True`` is ``--force``, ``workers=`` ``--workers``.

    Args:
        text: A message of the library.
        options: What the command that was run can be given, as argparse calls it: ``"learning_rate"``.
    """

    def option(found: re.Match[str]) -> str:
        name = _CALLED.get(found[1], found[1])
        if name not in options:
            return found[0]
        return f"--{name.replace('_', '-')}" + (f" {found[2]}" if found[2] else "")

    return _ARGUMENT.sub(option, text)
