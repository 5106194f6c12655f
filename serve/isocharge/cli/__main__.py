"""Entry point of `python -m isocharge.cli`."""

from isocharge.cli.main import main

if __name__ == "__main__":
    main()
