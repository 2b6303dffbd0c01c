"""Tests do not depend on luck, nor on how they were started.

Property tests draw the same examples every time, so that a run says something about the code and not about luck.

New examples are sought with `pytest --hypothesis-profile=explore`; what it finds belongs into a test as an @example.
"""

from __future__ import annotations

import signal

from hypothesis import settings

# A shell starts what runs in the background deaf to Ctrl-C, and children inherit that; tests that interrupt need ears.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.register_profile("explore", max_examples=500, deadline=None)
settings.load_profile("repeatable")
