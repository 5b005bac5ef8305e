"""``python -m postflight`` is the command ``postflight``."""

from postflight.cli import main

if __name__ == "__main__":
    main()
