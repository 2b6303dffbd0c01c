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


# What a thread has freed at the end of a heap of its own stays with the process.
THREADED = """
import threading
import numpy as np
from data_schema.memory import give_back, one_heap

def held():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmRSS"))

def work():
    np.ones(3_000_000)  # mapped by itself; freed, it tells the C library to keep so much at hand
    np.ones(2_500_000)
    done.wait()
    gone.wait()

one_heap()
before = held()
done, gone = threading.Barrier(5), threading.Barrier(5)
threads = [threading.Thread(target=work) for _ in range(4)]
for thread in threads:
    thread.start()
done.wait()
give_back()
print(held() - before)
gone.wait()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the GNU C library's own")
def test_what_threads_freed_goes_back() -> None:
    done = subprocess.run([sys.executable, "-c", THREADED], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 20_000  # kB, of 80 000
