"""Log messages of the library as lines on stderr."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def notices(*, quiet: bool = False) -> Iterator[None]:
    """Print the library's messages inside, each one once.

    Args:
        quiet: Whether to print nothing.
    """
    logger, handler, seen = logging.getLogger("cnpgen"), logging.StreamHandler(sys.stderr), set[str]()
    handler.setFormatter(logging.Formatter("cnpgen: %(message)s"))

    def is_new(record: logging.LogRecord) -> bool:
        known = record.getMessage() in seen
        seen.add(record.getMessage())
        return not known

    handler.addFilter(is_new)
    before = logger.level
    logger.setLevel(logging.WARNING if quiet else logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)
