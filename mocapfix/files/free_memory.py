"""Returning freed memory to the system."""

import ctypes
import gc


def return_free_memory() -> None:
    """Collect garbage, and return freed memory to the system where the C library can do so (glibc)."""
    gc.collect()
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
