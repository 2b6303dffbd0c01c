"""From a parameter box to computed runs: decks from a template, jobs, their table, the loop until the error is small enough.

A solver is a command line here, never a dependency.
"""
