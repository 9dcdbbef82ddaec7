"""Write a changed copy of an animation file, BVH or AMC: the bytes of the original with only the changed numbers replaced."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from mocapfix.animation import Animation
from mocapfix.errors import WriteError
from mocapfix.files.output_files import replace_atomically
from mocapfix.kernels.text_numbers import INTEGER_PART_BYTES, MAX_EXACT_PRODUCT, count_decimals, splice_numbers
from mocapfix.write.source_file import read_source_bytes
from mocapfix.write.text_tables import MAX_WRITTEN_DECIMALS

DEFAULT_DECIMALS = 6  # of a number in a file that has no number with decimals


def patch_animation(target: str | Path, source: Animation, values: Float[np.ndarray, "T C"]) -> None:
    """Write the file of `source` to `target` with the numbers that differ in `values`.

    All other bytes are unchanged: hierarchy, names, order of channels, line ends and the spelling of other numbers. New numbers
    have as many decimals as most numbers of the file that have any.

    Args:
        target: The copy.
        source: The animation as it was read.
        values: Values of all channels, as in `Animation.values`.

    Raises:
        WriteError: If `target` is the input or is not writable, the input has changed since it was read, or a changed number
            is not finite.
    """
    target = Path(target)
    if (starts := source.value_byte_offsets) is None:
        raise WriteError(f"{source.name}: there is no file with these numbers, so it cannot be patched.")
    data = read_source_bytes(target, source.path, int(starts.max(initial=-1)) + 1)
    is_changed = ~((values == source.values) | (np.isnan(values) & np.isnan(source.values)))
    offsets, numbers = starts[is_changed], _convert_to_file_units(source, values)[is_changed]
    order = np.argsort(offsets)
    text = np.frombuffer(data, np.uint8)
    counts = np.bincount(count_decimals(text, starts.ravel()))
    decimals = min(int(counts[1:].argmax()) + 1, MAX_WRITTEN_DECIMALS) if counts[1:].any() else DEFAULT_DECIMALS
    power = 10.0**decimals
    if not (np.abs(numbers) * power < MAX_EXACT_PRODUCT).all():
        frame, column = np.argwhere(is_changed & ~(np.abs(values) * power < MAX_EXACT_PRODUCT))[0]
        joint = next(name for name, own in zip(source.names, source.joint_columns, strict=True) if column in own)
        problem = f"in frame {source.first_frame + frame} a value of {joint} is {values[frame, column]}"
        raise WriteError(f"{target}: {problem}, which a file cannot hold.")
    out = np.empty(len(text) + len(offsets) * (INTEGER_PART_BYTES + decimals), np.uint8)
    size = splice_numbers(text, offsets[order], numbers[order], decimals, power, out)
    with replace_atomically(target) as part:
        part.write_bytes(out[:size].data)


def _convert_to_file_units(source: Animation, values: Float[np.ndarray, "T C"]) -> Float[np.ndarray, "T C"]:
    """Return values with angles in radians if the file uses radians."""
    if not source.uses_radians:
        return values
    columns = np.concatenate([source.get_rotation_channels(joint)[0] for joint in range(len(source.names))])
    converted = values.copy()
    converted[:, columns] = np.radians(values[:, columns])
    return converted
