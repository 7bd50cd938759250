"""One BLAS thread: for matrices as small as ours more only wait for each other, and take several times the CPU."""

import os
from contextlib import AbstractContextManager
from functools import cache
from typing import Any

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


_preferred: dict[str, str] = {}  # what this process has added to its environment


def prefer_one_thread() -> None:
    """Let BLAS libraries that are loaded from now on start with one thread, unless the environment says otherwise."""
    for variable in VARIABLES:
        if variable not in os.environ:
            os.environ[variable] = _preferred[variable] = "1"


def users_environment() -> dict[str, str]:
    """Return the environment without what ``prefer_one_thread`` has added to it."""
    return {name: value for name, value in os.environ.items() if _preferred.get(name) != value}


def one_thread() -> AbstractContextManager[Any]:
    """Compute with one BLAS thread inside."""
    limits: AbstractContextManager[Any] = _controller().limit(limits=1, user_api="blas")
    return limits


@cache
def _controller() -> Any:
    import numpy as np  # noqa: F401 - its BLAS must be there to be found
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
