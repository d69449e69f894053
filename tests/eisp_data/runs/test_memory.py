"""Freed memory is kept."""

import platform
import subprocess
import sys

import pytest

COUNT = """
import resource, sys
from eisp_data.runs.memory import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
def use():
    for _ in range(50):
        [bytearray(16 * 2**20) for _ in range(4)]
use()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
use()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(how: str) -> int:
    """Return how many pages a process is given while it takes 64 MB and frees them, 50 times."""
    out = subprocess.run(
        [sys.executable, "-c", COUNT, how], capture_output=True, text=True, check=True
    )
    return int(out.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc")
def test_memory_that_is_kept_is_not_got_anew():
    assert page_faults("keep") < 0.01 * page_faults("leave")
