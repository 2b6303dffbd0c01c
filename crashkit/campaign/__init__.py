"""From a parameter box to computed runs: decks from a template, jobs, their table, the loop until a wish is met.

A solver is a command line here, never a dependency.
"""
