"""The library's messages as a shell understands them: it names arguments as Python does, and options are meant."""

import re
from collections.abc import Container, Iterable

_ARGUMENT = re.compile(r"(?<![\w./=-])([a-z][a-z_]*)=(?:True\b|(\d+))?(?![\w\"'({\[./-])")
_CALLED = {"discard": "force", "other": "other_rows"}  # arguments whose options have another name


def in_shell(text: str, options: Container[str], words: Iterable[str] = ()) -> str:
    """Write the arguments that a message names as options: ``force=True`` is ``--force``, ``workers=`` ``--workers``.

    Args:
        text: A message of the library.
        options: What the command that was run can be given, as argparse calls it: ``"learning_rate"``.
        words: What was typed after the command; where the message repeats it (a folder ``seed=3``), it stays.
    """

    def option(found: re.Match[str]) -> str:
        name = _CALLED.get(found[1], found[1])
        if name not in options:
            return found[0]
        return f"--{name.replace('_', '-')}" + (f" {found[2]}" if found[2] else "")

    typed = sorted((word for word in words if "=" in word), key=len, reverse=True)
    parts = re.split("(" + "|".join(map(re.escape, typed)) + ")", text) if typed else [text]
    return "".join(part if index % 2 else _ARGUMENT.sub(option, part) for index, part in enumerate(parts))
