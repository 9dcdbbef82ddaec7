"""The stages in order for an animation: what a solver, a suit or a film made of somebody's joints, cleaned.

    animation = take.layout                       its own numbers, and what they mean: turns of joints, a place of the root
    body      = animated_body.of(...)             the joints of people among its own, where their names tell
    faults    = found(...)                        what is lost, pops and flips, trembles
    mended    = solve.turns.mended(...)           each as its kind allows
    put       = animated_changes.put(...)         what may be touched, is sure enough and was not decided against

Every other number stays as it was. The takes are of the joints' tips, so that a joint which turns wrongly is a point in the
wrong place.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from mocapfix import animated_body, animated_changes, change_file, joint_points, notes, record
from mocapfix.animation import Animation
from mocapfix.clock import Clock
from mocapfix.detect import turns as detected
from mocapfix.errors import TakeError
from mocapfix.faults import Fault, Faults
from mocapfix.fill import FillOptions
from mocapfix.result import Result
from mocapfix.solve import turns as solved
from mocapfix.solved import How
from mocapfix.take import Take


def clean(
    animation: Animation,
    how: How,
    hierarchy: str | Path | None,
    options: FillOptions,
    only: Sequence[str],
    files: Sequence[str | Path],
    clock: Clock,
) -> Result:
    """-> an animation cleaned: what is wrong with its joints' turns and its root's place found and mended, all else as it was.

    hierarchy  a style of joints' names or its YAML file; None: the one that finds most of people's joints
    files      the changes file of an earlier cleaning of this animation, with somebody's decisions
    Else as `pipeline.clean`, also in what it raises.
    """
    tips = joint_points.tips(animation)
    decided = change_file.of_each(files, [tips])[0]
    with clock("detect"):
        body, whose = animated_body.of(animation, hierarchy)
        faults = [fault for fault in found(animation) if not any(each.vouches(fault) for each in decided)]
    with clock("solve"):
        people = body.people(how) if body else None
        given = animation.parents, animation.places()[:, 0], animation.rotations(), orders(animation)
        mended = solved.mended(*given, faults, animation.rate, people)
    with clock("fill"):
        put = animated_changes.put(tips, mended, faults, options, only, decided)
        centres = put.centres
        subject, motion = body.moved(centres) if body else (None, None)
    report = {
        "take": record.of_take(centres, None),
        "faults": record.of_faults(put.before, put.faults),
        "changes": change_file.plain(put.changes),
        "subject": None,
        "solve": None,
        "fill": record.of_fill(put.before, put.before, put.after, put.left),
        "seconds": clock.seconds,
        "notes": [*animation.notes, whose, *notes.guesses(put.after)],
    }
    if body and motion is None:
        report["notes"].append("Numbers are missing that nothing could tell, so that there is no motion of the 31 joints.")
    takes = put.before, put.before, put.after
    return Result(*takes, put.faults, put.changes, put.left, (), subject, motion, None, None, report, centres=centres)


def inspected(animation: Animation, hierarchy: str | Path | None = None) -> dict:
    """-> the record's take, faults and notes of what `clean` would find."""
    _, whose = animated_body.of(animation, hierarchy)
    take, faults = joint_points.places(animation), Faults(tuple(found(animation)))
    return record.of_inspection(take, None, joint_points.tips(animation), faults, [*animation.notes, whose])


def found(animation: Animation) -> list[Fault]:
    """-> what is wrong with an animation, by joint and first frame; its markers are indices into `joint_points.tips`."""
    local, root = animation.rotations(), animation.places()[:, 0]
    faults = detected.found(animation.names, root, local, orders(animation), animation.rate)
    told = [replace(each, unit="rad") if each.marker < len(animation.names) else each for each in faults]
    return sorted(told, key=lambda fault: (fault.marker, fault.first))


def orders(animation: Animation) -> list[str]:
    """-> each joint's axes of rotation, the outermost first, as "ZYX"; "" where it has none of its own."""
    return ["".join("XYZ"[axis] for axis in animation.turning(j)[1]) for j in range(len(animation.names))]


def check(take: Take, about_markers: Mapping[str, object], hierarchy: object) -> None:
    """Raise TakeError where an option is given that is about what the take has not: markers or joints."""
    if not isinstance(take.layout, Animation):
        if hierarchy is not None:
            raise TakeError(f"{take.name}: has markers and no joints, of which --hierarchy tells; clean it without.")
    elif given := [option for option, value in about_markers.items() if value]:
        raise TakeError(f"{take.name}: has joints and no markers, of which {' and '.join(given)} tells; clean it without.")


def check_markers(take: Take) -> None:
    """Raise TakeError for a take that has no markers: bones and marker places are learnt from them."""
    if isinstance(take.layout, Animation):
        raise TakeError(f"{take.name}: has joints and no markers to learn from; give the capture that it was solved from.")
