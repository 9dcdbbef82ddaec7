"""Measuring what mocapfix does against what is known to be true."""
