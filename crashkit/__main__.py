"""`python -m crashkit` is the command line."""

from crashkit.cli import main

if __name__ == "__main__":
    main()
