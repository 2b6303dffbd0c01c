"""Freed memory goes back to the system."""

from __future__ import annotations

import subprocess
import sys

import pytest

# Blocks below the size that the C library maps by itself, every second one freed: a heap that cannot shrink from its end.
HOLED = """
import numpy as np
from data_schema.memory import give_back

def held():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmRSS"))

blocks = [np.ones(10_000) for _ in range(1000)]
del blocks[::2]
before = held()
give_back()
print(before - held())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the GNU C library's own")
def test_blocks_between_others_go_back() -> None:
    done = subprocess.run([sys.executable, "-c", HOLED], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 20_000  # kB, of 39 000
