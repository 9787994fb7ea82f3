"""The command line: each command parses its arguments, calls the room that does the work, and prints the result."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final

from epypes.deprecation import old_names

_INTERRUPTED: Final = 130

if not TYPE_CHECKING:
    __getattr__ = old_names(__name__)


def main(arguments: list[str] | None = None) -> None:
    """Run a command; an error of EPypes is printed as one line on standard error, with exit status 1."""
    import click

    from epypes.cli.app import app
    from epypes.errors import EpypesError
    from epypes.wording import without_access_key

    try:
        status = app.main(arguments, prog_name="epypes", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        status = error.exit_code
    except click.Abort:  # by Ctrl+C
        status = _INTERRUPTED
    except EpypesError as error:
        status = f"epypes: {error}"
    except OSError as error:  # of a file that the user named: no permission, no room, no such folder
        where = f"{error.filename} can't be used: " if error.filename else ""
        status = f"epypes: {where}{error.strerror or error}."
    except ModuleNotFoundError as error:
        from epypes.optional import missing_package

        # Only a package that an extra brings: any other missing module is a bug and shows its traceback.
        missing = missing_package(error)
        if missing is None:
            raise
        status = f"epypes: {missing}"
    # The user may have given a service by the link to its page.
    sys.exit(without_access_key(status) if isinstance(status, str) else status)
