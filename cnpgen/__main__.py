"""``python -m cnpgen``: the command line."""

import sys

from cnpgen.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
