"""Sentences that are said of markers, said of what a take has: an animation has joints."""

from mocapfix.animation import Animation
from mocapfix.take import Take


def worded(text: str, take: Take) -> str:
    """-> a sentence about markers as one about the take's points. It must hold no names out of files, which stay as they are."""
    if not isinstance(take.layout, Animation):
        return text
    return text.replace("marker", "joint").replace("Marker", "Joint").replace("measured", "read").replace("sample", "value")
