"""`python -m crashkit` is the command line."""

from crashkit.siblings import forget_working_folder

if __name__ == "__main__":
    forget_working_folder()  # before anything of the command line is imported

from crashkit.cli import main

if __name__ == "__main__":
    main()
