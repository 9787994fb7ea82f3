"""The commands: each parses, calls and prints, in a file of its own."""

from __future__ import annotations

import sys


def main(arguments: list[str] | None = None) -> None:
    """Run a command; what EPypes refuses is one line on standard error and exit status 1."""
    from epypes.cli.app import app
    from epypes.errors import EpypesError
    from epypes.optional import missing_package

    try:
        app(args=arguments, prog_name="epypes")
    except EpypesError as error:
        sys.exit(f"epypes: {error}")
    except ModuleNotFoundError as error:
        # Only what an extra brings: another module that is missing is a bug and shows its traceback.
        missing = missing_package(error)
        if missing is None:
            raise
        sys.exit(f"epypes: {missing}")
