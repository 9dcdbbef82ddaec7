"""Names of the marker on the other side."""


def other_side(label: str) -> str:
    """Return the name of the same marker on the other side, of a median marker its own name."""
    words = {"Left": "Right", "LFront": "RFront", "LBack": "RBack", "left": "right"}
    for left, right in words.items():
        if left in label or right in label:
            return label.replace(left, right) if left in label else label.replace(right, left)
    if label in ("BackL", "BackR", "HeadL", "HeadR", "WaistL", "WaistR"):
        return label[:-1] + {"L": "R", "R": "L"}[label[-1]]
    if label.endswith("_study"):  # OpenCap writes a capital L and a small r
        return {"L": "r", "r": "L"}.get(label[0], label[0]) + label[1:]
    swapped = {"l ": "r ", "r ": "l "}.get(label[:2])  # BTS
    return swapped + label[2:] if swapped else {"L": "R", "R": "L"}.get(label[0], label[0]) + label[1:]
