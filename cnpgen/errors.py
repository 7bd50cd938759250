"""Exceptions of the public interface, their exit codes, and parts of their messages."""

import difflib
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

# Characters of a message; exceptions of libraries may repeat the content of a file.
MAX_LINE_LENGTH = 4000
# Errors of a file that a message lists.
MAX_ERROR_LINES = 30

Spelling = Callable[[str, object], str]
"""Writes an argument with the value that a message proposes for it, None for any value."""


def python_spelling(name: str, value: object) -> str:
    """Write an argument as in a Python call: ``force=True``, ``out=``."""
    return f"{name}={'' if value is None else repr(value)}"


def _limited(text: str) -> str:
    """Keep the beginning and the end of a long text."""
    if len(text) <= MAX_LINE_LENGTH:
        return text
    # With the note, the text stays within the limit.
    kept = MAX_LINE_LENGTH // 2 - 30
    return f"{text[:kept]} [... {len(text) - 2 * kept:,} more characters ...] {text[-kept:]}"


class CnpgenError(Exception):
    """Base class of all exceptions that cnpgen raises intentionally.

    Args:
        message: The error. With ``argument`` it is a predicate: "must be positive, got
            0". ``{name}`` stands for an argument of ``remedies``.
        argument: Name of the invalid argument, which begins the text.
        concerns: Name of the invalid argument if the message is a whole sentence; by
            default the first of ``remedies``.
        remedies: Arguments that the message proposes, name -> value; None for any
            value.

    Attributes:
        exit_code: Exit code of the command line.
        argument: Name of the invalid argument, or None.
        remedies: Arguments that the message proposes.
        is_predicate: Whether the text begins with the name of the argument.
    """

    exit_code = 2
    argument: str | None = None
    remedies: Mapping[str, object] = {}
    is_predicate = False

    def __init__(
        self,
        message: str = "",
        *,
        argument: str | None = None,
        concerns: str | None = None,
        remedies: Mapping[str, object] | None = None,
    ) -> None:
        super().__init__(message)
        self.remedies = remedies or {}
        self.argument = argument or concerns or next(iter(self.remedies), None)
        self.is_predicate = argument is not None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the keyword arguments and notes, too, for worker processes."""
        return type(self), self.args, vars(self)

    def text(self, spelling: Spelling = python_spelling) -> str:
        """Return the message with all arguments in one spelling, by default as in a Python call.

        A message of more than ``MAX_LINE_LENGTH`` characters keeps its beginning and
        its end.
        """
        text = " ".join(str(part) for part in self.args)
        for name, value in self.remedies.items():
            text = text.replace(f"{{{name}}}", spelling(name, value))
        if self.argument is not None and self.is_predicate:
            text = spelling(self.argument, None).removesuffix("=") + " " + text
        return _limited(text)

    def __str__(self) -> str:
        return self.text()


class UsageError(CnpgenError):
    """An invalid argument or combination of arguments."""


class RecipeError(CnpgenError):
    """One or more errors in a problem, pipeline or dataset file.

    Args:
        errors: One line per error, with file and key.
    """

    def __init__(self, errors: Sequence[str]) -> None:
        self.errors = tuple(_limited(error) for error in errors)
        # Required for pickling in worker processes.
        Exception.__init__(self, self.errors)

    def __str__(self) -> str:
        lines = list(self.errors[:MAX_ERROR_LINES])
        if more := len(self.errors) - len(lines):
            lines.append(f"and {more:,} more error{'s' * (more > 1)}")
        return "\n".join(lines)

    @property
    def mistakes(self) -> tuple[str, ...]:
        """The former name of ``errors``, for one version."""
        warnings.warn(
            "RecipeError.mistakes is errors; the next version has no mistakes",
            DeprecationWarning,
            stacklevel=2,
        )
        return self.errors


class PluginError(RecipeError):
    """A recipe needs stages, constraints or robots of packages that are not installed."""

    exit_code = 3


class DatasetError(CnpgenError):
    """A dataset on disk that is damaged, unfinished or of another kind than requested."""

    exit_code = 1


class MachineError(CnpgenError):
    """A failure of the machine: no compiler, a full disk, a folder without write permission, a dead worker."""

    exit_code = 3


class MissingExtraError(MachineError, ImportError):
    """An optional package that is missing or broken.

    The message names the extra of cnpgen that installs it.
    """


class MissingAddonError(MachineError, ImportError):
    """A package below ``cnpgen/addons`` that this installation lacks.

    The message names it and what needs it.
    """


@contextmanager
def requires_extra(extra: str, package: str, options: str = "") -> Iterator[None]:
    """Raise MissingExtraError if an import in the block fails.

    Args:
        extra: Name of the extra in pyproject.toml.
        package: Name of the package, for the message.
        options: Further options of pip, with a space before them.
    """
    try:
        yield
    except (
        ImportError,
        OSError,
        AttributeError,
    ) as error:
        # Broken installations raise any of them.
        raise MissingExtraError(
            f"{package} cannot be imported ({error}): pip install 'cnpgen[{extra}]'{options}"
        ) from error


SYNONYMS = {  # words of other projects -> the word of a name here
    "speed": "velocity",
    "effort": "torque",
    "load": "inspect",
    "open": "inspect",
    "info": "inspect",
    "verify": "validate",
    "generate": "make-dataset",
    "new": "init",
    "optimize": "refine",
    "judge": "evaluate",
    "check": "evaluate",
    "visualize": "view",
    "render": "view",
    "help": "docs",
}


def nearest(name: str, known: Iterable[str], *, similarity: float = 0.5) -> str:
    """Return ``" (did you mean 'x'?)"`` for a synonym or the most similar known name, or an empty string.

    ``similarity`` is the minimum share of equal letters.
    """
    names = list(known)
    meant = "-".join(SYNONYMS.get(word, word) for word in name.split("-"))
    if meant != name and meant in names:
        return f" (did you mean {meant!r}?)"
    # Words in capitals mean the same ones.
    lower = {each.lower(): each for each in names}
    word = name.lower()
    completions = [each for each in lower if len(word) > 2 and each.startswith(word)]
    close = (
        difflib.get_close_matches(word, lower, n=1, cutoff=similarity) or completions
    )
    return f" (did you mean {lower[close[0]]!r}?)" if close else ""


def listed(names: Sequence[object], most: int = 20) -> str:
    """Join names for a message, at most so many: ``"a, b and 3 more"``."""
    text = ", ".join(map(str, names[:most]))
    return f"{text} and {len(names) - most:,} more" if len(names) > most else text


def lacks(noun: str, name: str, known: Iterable[str]) -> str:
    """Return the message for an unknown name: ``"has no split 'x', only train, test"``."""
    names = list(known)
    return (
        f"has no {noun} {name!r}{nearest(name, names)}, only {listed(names) or 'none'}"
    )


def either(choices: Sequence[str]) -> str:
    """Join alternatives: ``"problem, pipeline or dataset"``."""
    return " or ".join(filter(None, (", ".join(choices[:-1]), choices[-1])))


def counted(number: int, noun: str) -> str:
    """Format a number with its noun: ``"1 row"``, ``"120,000 rows"``, ``"2 trajectories"``."""
    plural = f"{noun[:-1]}ies" if noun.endswith("ry") else f"{noun}s"
    return f"{number:,} {noun if number == 1 else plural}"
