"""Reuse of freed memory by the C library."""

from __future__ import annotations

import ctypes
import sys

__all__ = ["keep_memory"]

# parameters of mallopt(3), and the most that they take: blocks from 32 MiB on still come from the system one
# by one; what is freed below goes back to it from 2 GiB on
_MMAP_THRESHOLD, _TRIM_THRESHOLD = (-3, 32 * 2**20), (-1, 2**31 - 1)


def keep_memory() -> bool:
    """Have the C library keep freed memory for the next tensors.

    By default glibc returns large blocks to the system at once, and the system fills new ones with zeros page
    by page, which takes a tenth of an update's time or more. The process then keeps the most memory that it
    ever used.

    Returns:
        whether the C library could be set so; only glibc can.

    >>> keep_memory() in (True, False)
    True
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    return all([mallopt(*_MMAP_THRESHOLD), mallopt(*_TRIM_THRESHOLD)])
