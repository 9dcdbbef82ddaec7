"""The units of length that files name, and how long they are."""

METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254, "ft": 0.3048}
# What a unit is called where it is written out, "Millimetres" or "Meters", without its plural.
SHORT = {"millimeter": "mm", "millimetre": "mm", "centimeter": "cm", "centimetre": "cm", "meter": "m", "metre": "m"}
SHORT |= {"inche": "in", "inch": "in", "foot": "ft", "feet": "ft"}


def metres(name: str) -> float | None:
    """-> metres in the unit of that name, short or written out, in either case; None where it is none."""
    plain = name.strip().lower()
    return METRES.get(SHORT.get(plain.removesuffix("s"), plain))
