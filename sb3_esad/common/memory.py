"""Keep the C library from returning memory to the system between updates."""

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGEST_TRIM, _LARGEST_THRESHOLD = 2**31 - 1, 2**25


def keep_freed_memory() -> None:
    """
    Let glibc re-use freed tensors instead of asking the kernel for zeroed pages at each update.

    On a virtual machine the page faults of large tensors take longer than the arithmetic on them. Other C libraries and
    systems are left alone.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        # Above the largest threshold, which no tensor of an update reaches, a replay buffer still gets pages as it fills
        mallopt(_M_MMAP_THRESHOLD, _LARGEST_THRESHOLD)
        mallopt(_M_TRIM_THRESHOLD, _LARGEST_TRIM)
