"""``cnpgen`` and ``python -m cnpgen``: the command line, interruptible from its first import on."""

import sys

INTERRUPTED = 130  # as of ``cnpgen.cli.interruption``, which is still to be imported


def main() -> int:
    """Run the command line; return the exit code."""
    try:
        from cnpgen.cli.main import main as run
    except KeyboardInterrupt:
        print("cnpgen: interrupted", file=sys.stderr)
        return INTERRUPTED
    return run()


if __name__ == "__main__":
    sys.exit(main())
