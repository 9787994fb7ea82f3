"""The command line without its script: ``python -m epypes``."""

from epypes.cli import main

if __name__ == "__main__":
    main()
