"""The commands: each parses, calls and prints, in a file of its own."""

from __future__ import annotations

import sys


def main(arguments: list[str] | None = None) -> None:
    """Run a command; what EPypes refuses is one line on standard error and exit status 1."""
    from epypes.cli.app import app
    from epypes.errors import EpypesError

    try:
        app(args=arguments, prog_name="epypes")
    except EpypesError as error:
        sys.exit(f"epypes: {error}")
    except ModuleNotFoundError as error:
        # Only what an extra brings: a module missing in our own packages is a bug and shows its traceback.
        if error.name is None or error.name.partition(".")[0] in ("epypes", "epypes_widgets"):
            raise
        sys.exit(f"epypes: module {error.name!r} is missing. Run: pip install 'epypes[all]'")
