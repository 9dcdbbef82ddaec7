"""Reading ASF/AMC, the form in which CMU publishes its motion: the skeleton in one file, a trial's numbers in another.

An ASF bone has axes of its own, turned by C from the world's in the rest pose; its turn M in the AMC is about those. In the
axes of the world that is C M C^-1.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.animation import Animation
from mocapfix.errors import ReadError
from mocapfix.joint_points import places
from mocapfix.read.asf import Figure, figure
from mocapfix.read.figure import sized, upright
from mocapfix.read.numbers import Words, words
from mocapfix.read.opened import file_bytes
from mocapfix.take import Take

FIRST = re.compile(rb"(?:^|(?<=[\r\n]))[ \t]*\d+[ \t]*(?=[\r\n]|$)")  # the line with the first frame's number
# no keyword of the format says the rate: what a comment or a keyword of some program's own says is taken
RATE_SAID = re.compile(rb":SAMPLES-PER-SECOND\s+(\d+\.?\d*)|(\d+\.?\d*) ?(?:fps|Hz|frames (?:a|per) second)", re.IGNORECASE)
RATE = 120.0  # Hz: CMU's, but for some subjects at 60
BONES = b":bonedata"
# comments, keywords, and then the first frame's number and a bone's
BEGINS = re.compile(rb"\s*(?:[#:][^\n]*\n\s*)*\d+[ \t]*\r?\n[ \t]*[A-Za-z]\S*(?:[ \t]+[-+.\d]\S*)+[ \t]*\r?(?:\n|$)")


def recognises(head: bytes) -> bool:
    """-> does a file that begins so claim to be an AMC, or the ASF that goes with one?"""
    lower = head.lower()
    keywords = b":fully-specified", b":degrees", b":radians"  # a file that was cut off may have no more
    return BONES in lower or lower.lstrip().startswith(keywords) or bool(BEGINS.match(head))


def take(path: Path, data: bytes) -> Take:
    """-> the take of the joints that move in an AMC's bytes. Raises ReadError as `animation`, and for a skeleton alone."""
    if BONES in data.lower():
        raise ReadError(f"{path}: is a skeleton without motion; name the AMC that moves it.")
    return places(animation(path, data))


def animation(path: str | Path, data: bytes | None = None, skeleton: str | Path | None = None) -> Animation:
    """-> the motion of an AMC on the `skeleton`, an ASF, that is given or beside it; or the rest pose of an ASF, as one frame.

    Angles are in degrees, whatever the file has them in. Joints are where bones begin and carry their names.

    data  the file's bytes, where they were read already

    Raises ReadError where the AMC's skeleton is not beside it, and, naming file and line, where either has a fault.
    """
    path = Path(path)
    data = file_bytes(path) if data is None else data
    if BONES in data.lower():
        return _at_rest(path, data)
    beside = Path(skeleton) if skeleton is not None else skeleton_of(path)
    body = figure(beside, _text(file_bytes(beside)))
    start = FIRST.search(data)
    if not start:
        raise ReadError(f"{path}: holds no frames; an AMC has a line with each frame's number. Export it again.")
    found = words(data, start.start())
    first, at = _places(path, found, body)
    said = RATE_SAID.search(data[: start.start()])
    rate = float(said[1] or said[2]) if said else 0.0
    notes = () if rate > 0 else (f"An AMC does not say its rate; {RATE:.0f} Hz, CMU's, was taken.",)
    values, radians = found.values[at], b":radians" in data[: start.start()].lower()
    read = _animation(path, body, values, rate or RATE, (f"Its skeleton is {beside.name}.", *notes), first)
    read = replace(read, starts=found.starts[at], skeleton=beside, radians=radians)
    if not radians:
        return read
    turning = np.concatenate([read.turning(joint)[0] for joint in range(len(read.names))])
    values[:, turning] = np.degrees(values[:, turning])
    return read


def skeleton_of(path: Path) -> Path:
    """-> the ASF beside an AMC: of those whose name the AMC's begins with (02.asf for 02_01.amc) the longest, else the only one.

    Raises ReadError where there is none or which it is cannot be told.
    """
    beside = sorted(each for each in path.parent.iterdir() if each.suffix.lower() == ".asf")
    own = [each for each in beside if path.stem.lower().startswith(each.stem.lower())]
    if own:
        return max(own, key=lambda each: len(each.stem))
    if len(beside) == 1:
        return beside[0]
    there = f"only {', '.join(each.name for each in beside)}" if beside else "no ASF"
    likely = " or ".join(f"{stem}.asf" for stem in dict.fromkeys((path.stem.partition("_")[0], path.stem)))
    raise ReadError(f"{path}: its skeleton is not beside it, {there}; put it there as {likely}.")


def _at_rest(path: Path, data: bytes) -> Animation:
    body = figure(path, _text(data))
    width = sum(len(bone.freedoms) for bone in body.bones)
    return _animation(path, body, np.zeros((1, width)), RATE, ("It is a skeleton without motion, in its rest pose.",), 1)


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _animation(path: Path, body: Figure, values: np.ndarray, rate: float, notes: tuple[str, ...], first: int) -> Animation:
    """-> the animation of a figure, its values in the order of its channels."""
    names = tuple(bone.name for bone in body.bones)
    parents = np.array([names.index(bone.parent) if bone.parent else -1 for bone in body.bones])
    tips = np.array([bone.tip for bone in body.bones])
    leaves = [joint not in parents for joint in range(len(names))]
    read = Animation(
        names=names,
        parents=parents,
        offsets=np.vstack([body.place, tips[parents[1:]]]),
        ends=tuple(tip[None] if leaf else np.empty((0, 3)) for tip, leaf in zip(tips, leaves, strict=True)),
        channels=tuple(bone.channels for bone in body.bones),
        values=values,
        rate=rate,
        path=path,
        first_frame=first,
        unit=body.unit,
        rest=np.array([bone.axes for bone in body.bones]),
        added=np.ones(len(names), bool),
        notes=notes,
    )
    return sized(upright(read))


def _places(path: Path, found: Words, body: Figure) -> tuple[int, np.ndarray]:
    """-> the first frame's number, and (T, C) which of the words is each frame's number for each channel.

    Raises ReadError at a word that is no number, a bone the skeleton has not, or one that lacks, comes twice or has too few
    numbers.
    """
    heads = np.flatnonzero(np.diff(found.lines, prepend=-1))
    counts = np.diff(heads, append=len(found))
    named = ~found.is_number[heads]
    stray = ~found.is_number
    stray[heads] = False
    if stray.any() or (bad := ~named & (counts != 1)).any():
        at = int(np.argmax(stray)) if stray.any() else heads[np.argmax(bad)]
        what = f"{found.word(at)[:40]!r} stands where a bone's numbers or a frame's belong"
        raise ReadError(f"{path}, line {found.lines[at]}: {what}.")
    frame = np.cumsum(~named)
    lines: dict[str, list[int]] = {bone.name: [] for bone in body.bones}
    for line in np.flatnonzero(named).tolist():
        name = found.word(heads[line])
        if name not in lines:
            raise ReadError(f"{path}, line {found.lines[heads[line]]}: bone {name[:40]} is not in the skeleton.")
        lines[name].append(line)
    columns = []
    for bone in body.bones:
        if bone.freedoms:
            own = np.array(lines[bone.name], int)
            _check(path, found, bone.name, heads[~named], frame[own], heads[own], counts[own] - 1, len(bone.freedoms))
            columns.append(heads[own, None] + 1 + np.array(bone.columns))
    return int(found.values[heads[0]]), np.hstack(columns)


def _check(
    path: Path, found: Words, name: str, frames: np.ndarray, own: np.ndarray, heads: np.ndarray, counts: np.ndarray, width: int
) -> None:
    """Raise ReadError unless a bone is there once in every frame, with `width` numbers.

    frames (T,) the words that are the frames' numbers; own (n,) the frame of each of the bone's lines, the first being 1,
    heads (n,) the words they begin with, counts (n,) their numbers.
    """
    times = np.bincount(own, minlength=len(frames) + 1)[1:]
    if (times != 1).any():
        at = frames[np.argmax(times != 1)]
        how = "twice" if times.max() > 1 and times[np.argmax(times != 1)] > 1 else "not"
        raise ReadError(f"{path}, line {found.lines[at]}: bone {name} is {how} in frame {found.word(at)}.")
    if (counts != width).any():
        at = int(np.argmax(counts != width))
        raise ReadError(f"{path}, line {found.lines[heads[at]]}: {name} has {counts[at]} numbers where its freedoms are {width}.")
