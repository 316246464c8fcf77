"""What every command of this project does with bad input: one line, exit code 2."""

import sys
from collections.abc import Callable

from msg_defs.errors import InputError


def run(app: Callable[[], object]) -> None:
    """Run a command-line app; an `InputError` becomes one line on stderr and exit code 2."""
    try:
        app()
    except InputError as error:
        print("error:", "; ".join(str(error).splitlines()), file=sys.stderr)
        sys.exit(2)
