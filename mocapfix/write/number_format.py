"""Format rows of numbers as "%.6f" does, many times as fast."""

import numpy as np
from jaxtyping import Float

from mocapfix.kernels.text_numbers import INTEGER_PART_BYTES, MAX_EXACT_PRODUCT, write_rows

MAX_WRITTEN_DECIMALS = 15


def format_rows(values: Float[np.ndarray, "T C"], decimals: int, separator: str = " ", line_end: str = "\n") -> bytes:
    """Return one line of text for each row.

    Numbers are exactly those of f"{value:.6f}" with `decimals` (0 to 15) decimals, including the sign of -0.0.

    Raises:
        ValueError: If a number is not finite.
    """
    values = np.ascontiguousarray(values, float)
    if not np.isfinite(values).all():
        raise ValueError("a number that is not finite cannot be written")
    power = 10.0**decimals
    if values.size == 0 or decimals > MAX_WRITTEN_DECIMALS or np.abs(values).max() >= MAX_EXACT_PRODUCT / power:
        template = separator.join([f"%.{decimals}f"] * values.shape[1]) + line_end
        return "".join([template % tuple(row) for row in values.tolist()]).encode()
    separator_bytes = np.frombuffer(separator.encode(), np.uint8)
    line_end_bytes = np.frombuffer(line_end.encode(), np.uint8)
    size = values.size * (INTEGER_PART_BYTES + decimals + len(separator_bytes)) + len(values) * len(line_end_bytes)
    out = np.empty(size, np.uint8)
    return out[: write_rows(values, decimals, power, separator_bytes, line_end_bytes, out)].tobytes()
