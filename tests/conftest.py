"""Property tests draw the same examples every time, so that a run says something about the code and not about luck.

New examples are sought with `pytest --hypothesis-profile=explore`; what it finds belongs into a test as an @example.
"""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.register_profile("explore", max_examples=500, deadline=None)
settings.load_profile("repeatable")
