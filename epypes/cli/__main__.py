"""How is the command line run without its script? ``python -m epypes.cli``."""

from epypes.cli import main

if __name__ == "__main__":
    main()
