"""The command line as ``python -m mitsonar``."""

from mitsonar.cli import main

if __name__ == "__main__":
    main()
