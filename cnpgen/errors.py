"""The exceptions that users may want to catch, and the exit codes they turn into."""

import difflib
from collections.abc import Iterable, Sequence


class CnpgenError(Exception):
    """Base of everything cnpgen raises on purpose.

    Attributes:
        exit_code: What the command line exits with.
    """

    exit_code = 2


class UsageError(CnpgenError):
    """An argument or a combination of arguments that cannot be meant."""


class RecipeError(CnpgenError):
    """One or more mistakes in a problem, pipeline or dataset file.

    Args:
        mistakes: One line each, with file and key.
    """

    def __init__(self, mistakes: Sequence[str]) -> None:
        self.mistakes = tuple(mistakes)
        super().__init__(self.mistakes)  # so that it can be pickled by worker processes

    def __str__(self) -> str:
        return "\n".join(self.mistakes)


class PluginError(RecipeError):
    """A recipe needs stages, constraints or robots of packages that are not installed here."""

    exit_code = 3


class DatasetError(CnpgenError):
    """A dataset on disk that is damaged, unfinished or not what was asked for."""

    exit_code = 1


class MachineError(CnpgenError):
    """The machine cannot do what is asked: no compiler, full disk, unwritable folder, a dead worker."""

    exit_code = 3


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ``" (did you mean 'x'?)"`` for the known name nearest to ``name``, or an empty string."""
    names = list(known)
    begun = [each for each in names if len(name) > 2 and each.startswith(name)]
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5) or begun
    return f" (did you mean {close[0]!r}?)" if close else ""


def lacks(noun: str, name: str, known: Iterable[str]) -> str:
    """Say that something is not among what there is: ``"has no split 'x', only train, test"``."""
    names = list(known)
    return f"has no {noun} {name!r}{nearest(name, names)}, only {', '.join(names) or 'none'}"


def either(choices: Sequence[str]) -> str:
    """Join what there is a choice of: ``"problem, pipeline or dataset"``."""
    return " or ".join(filter(None, (", ".join(choices[:-1]), choices[-1])))


def counted(number: int, noun: str) -> str:
    """Write a number of things: ``"1 row"``, ``"120,000 rows"``."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"
