"""Arguments of error messages in the spelling of the command line."""

from collections.abc import Container

from cnpgen.errors import Spelling, python_spelling

_OPTIONS = {"discard": "force", "other": "other_rows"}  # arguments whose options have another name


def shell_spelling(options: Container[str]) -> Spelling:
    """Return a spelling for ``CnpgenError.text``: ``force=True`` becomes ``--force``, ``workers=2`` ``--workers 2``.

    Args:
        options: Options of the command, as argparse names them: ``"learning_rate"``. Other arguments keep the Python
            spelling.
    """

    def spell(name: str, value: object) -> str:
        option = _OPTIONS.get(name, name)
        if option not in options:
            return python_spelling(name, value)
        text = f"--{option.replace('_', '-')}"
        return text if value is None or isinstance(value, bool) else f"{text} {value}"

    return spell
