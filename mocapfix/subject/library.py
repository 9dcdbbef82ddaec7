"""The library of marker sets, of anatomical landmarks and of subjects, as YAML, and the choice of a take's set.

The shipped sets are in scenes/marker-sets, those of a studio anywhere. A take gets the set that the options name, or the
shipped one that fits its labels. Landmarks have one place each on the average body, to which marker sets and detectors of
keypoints refer. A subject file has one person's bones and marker offsets, which people can read, edit and use again.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.errors import SceneError, TakeError, format_name_list
from mocapfix.io.files import replace_atomically
from mocapfix.io.shipped import InlineMapping, dump_yaml, find_by_name, find_shipped_folder, keep_parsed, read_shipped_yaml
from mocapfix.model.marker_set import MIN_SINGLE_LIMB_MARKERS, MarkerSet, index_labels_by_prefix
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import SubjectOptions
from mocapfix.stats.marker_distances import MIN_GROUP_MARKERS

if TYPE_CHECKING:
    from mocapfix.io.yaml_files import BoneModel, SetMarkerModel

SUBJECT_FILE_HEADER = """\
# A subject of mocapfix: one person's bones and the markers on them. All lengths are in metres.
# offset: the joint in its parent's axes; end: the tip of a last bone in its joint's axes; place: the marker in the axes of its
# joint; spread: typical distance per axis of the marker from its place; sd: standard deviation per axis of the joint or marker
# due to the uncertainty of the calibration (0 if it was measured otherwise).
# Rest pose: a T-pose facing +Z, Y up, with all joint axes parallel to the world axes.
"""
LENGTH_DECIMALS = 7  # decimals of the lengths in the file: a tenth of a micrometre


def read_subject(path: str | Path) -> Subject:
    """Return the subject in a file, possibly edited. Raises SceneError with the file and the path of the invalid key."""
    from mocapfix.io.yaml_files import SubjectModel, read_yaml_model

    model = read_yaml_model(SubjectModel, Path(path))
    _check_bones(Path(path), model.bones)
    skeleton, markers = load_cmu31_body().skeleton, model.markers.values()
    bones = [model.bones[name] for name in skeleton.names]
    return Subject(
        skeleton=Skeleton(
            skeleton.names,
            skeleton.parents,
            np.array([bone.offset for bone in bones], float),
            np.array([bone.end or [np.nan] * 3 for bone in bones], float),
        ),
        marker_set=model.marker_set,
        labels=tuple(model.markers),
        joints=np.array([skeleton.find_joint(marker.joint) for marker in markers], int),
        marker_offsets=np.array([marker.place for marker in markers], float).reshape(-1, 3),
        marker_spread=np.array([marker.spread for marker in markers], float),
        joint_sd=np.array([bone.sd for bone in bones], float),
        marker_sd=np.array([marker.sd for marker in markers], float),
        frame_count=model.frames,
        notes=model.notes,
    )


def write_subject(path: str | Path, subject: Subject) -> None:
    """Write a subject as YAML, with lengths rounded to LENGTH_DECIMALS.

    Raises:
        WriteError: If the folder cannot be written; an existing file is then left unchanged.
    """
    skeleton, names = subject.skeleton, subject.skeleton.names
    bones: dict[str, InlineMapping] = {}
    markers: dict[str, InlineMapping] = {}
    for name, parent, offset, end, sd in zip(
        names, skeleton.parents, skeleton.offsets, skeleton.ends, subject.joint_sd, strict=True
    ):
        bones[name] = InlineMapping(
            parent=names[parent] if parent >= 0 else None, offset=_round_lengths(offset), sd=_round_length(sd)
        )
        if not np.isnan(end).any():
            bones[name]["end"] = _round_lengths(end)
    for label, joint, offset, spread, sd in zip(
        subject.labels, subject.joints, subject.marker_offsets, subject.marker_spread, subject.marker_sd, strict=True
    ):
        markers[label] = InlineMapping(
            joint=names[joint], place=_round_lengths(offset), spread=_round_length(spread), sd=_round_length(sd)
        )
    notes = {"notes": list(subject.notes)} if subject.notes else {}
    data = {"marker_set": subject.marker_set, "frames": int(subject.frame_count), "bones": bones, "markers": markers, **notes}
    with replace_atomically(Path(path)) as new_file:
        new_file.write_text(SUBJECT_FILE_HEADER + dump_yaml(data), encoding="utf-8", newline="\n")


def _round_lengths(vector: np.ndarray) -> list[float]:
    return [_round_length(x) for x in vector]


def _round_length(value: float) -> float:
    return round(float(value), LENGTH_DECIMALS)


def _check_bones(path: Path, bones: dict[str, "BoneModel"]) -> None:
    """Raise SceneError unless the bones are those of the CMU skeleton, the only tree that the solver supports."""
    skeleton = load_cmu31_body().skeleton
    for name, bone in bones.items():
        if name not in skeleton.names:
            raise SceneError(
                f"{path}: bones.{name}: the skeleton has no such bone; its bones are {format_name_list(skeleton.names)}."
            )
        joint = skeleton.find_joint(name)
        parent = skeleton.names[skeleton.parents[joint]] if joint else None
        if bone.parent != parent:
            raise SceneError(f"{path}: bones.{name}.parent: must be {parent or 'null'}, not {bone.parent or 'null'}.")
        if (bone.end is None) != np.isnan(skeleton.ends[joint]).any():
            raise SceneError(
                f"{path}: bones.{name}.end: {'is missing' if bone.end is None else 'only the last bone of a chain has one'}."
            )
    if missing := [name for name in skeleton.names if name not in bones]:
        raise SceneError(f"{path}: bones.{missing[0]}: is missing.")


MIRROR_X = np.array([-1.0, 1.0, 1.0])  # the body rests facing +Z, so left and right differ in the sign of x
MAX_MEDIAN_DISTANCE_M = 0.008  # from the median plane, of a landmark of pelvis, trunk or head of neither side


class Landmark(NamedTuple):
    """A landmark on the average body."""

    joint_name: str  # the joint that carries it
    offset: Float[np.ndarray, "3"]  # m: its position in the axes of the joint
    spread: float  # m: standard deviation per axis, over people, of a marker on it about the offset


def find_landmark(name: str) -> Landmark:
    """Return a landmark by its name, of paired ones with the side before it: "left acromion", "sacrum".

    Raises ValueError, with a sentence that lists the landmarks, if there is none of that name.
    """
    landmarks = load_landmarks()
    side, _, rest = name.partition(" ")
    if name in landmarks and _is_median(landmarks[name]):
        return landmarks[name]
    if side in ("left", "right") and rest in landmarks:
        landmark = landmarks[rest]
        if side == "left":
            return landmark
        return Landmark(landmark.joint_name.replace("Left", "Right"), landmark.offset * MIRROR_X, landmark.spread)
    known = [key if _is_median(landmark) else f"left {key}" for key, landmark in landmarks.items()]
    raise ValueError(f"there is no landmark {name!r}; the landmarks are {format_name_list(known)}, and those on the right")


@cache
def load_landmarks() -> dict[str, Landmark]:
    """Return the left and the median landmarks by their names without a side, from scenes/skeletons/landmarks.yaml."""
    landmarks = read_shipped_yaml("skeletons/landmarks.yaml")["landmarks"].items()
    return {name: Landmark(each["joint"], np.array(each["offset"], float), each["spread"]) for name, each in landmarks}


def _is_median(landmark: Landmark) -> bool:
    return not landmark.joint_name.startswith("Left") and abs(float(landmark.offset[0])) <= MAX_MEDIAN_DISTANCE_M


MAX_LISTED_LABELS = 2  # of a take that no set fits, in a sentence that has two more lists
MARKER_OFFSET_DECIMALS = 4  # of lengths in metres in a file: markers are placed less accurately than 0.1 mm


@cache
def load_shipped_marker_sets() -> tuple[MarkerSet, ...]:
    scenes, package = find_shipped_folder("scenes"), Path(__file__).parent.parent
    paths = sorted(scenes.glob("marker-sets/*.yaml"))
    modules = "model/marker_set.py", "model/skeleton.py", "io/shipped.py", "io/yaml_files.py", "subject/library.py"
    others = [*sorted(scenes.glob("skeletons/*.yaml")), *(package / each for each in modules)]
    return keep_parsed("marker-sets", [*paths, *others], lambda: tuple(_read_marker_set(path) for path in paths))


def load_whole_body_marker_sets() -> tuple[MarkerSet, ...]:
    """Return the shipped sets of markers on all sections of the body: neither those of legs alone nor those of keypoints."""
    return tuple(each for each in load_shipped_marker_sets() if not each.point_sd and each.covers_whole_body)


def load_marker_set(name_or_path: str | Path) -> MarkerSet:
    """Return a shipped marker set by its name, or the set in a YAML file.

    Raises:
        SceneError: If there is no such set (the message lists the shipped ones) or the file has a wrong key.
    """
    set_of_name = {each.name: each for each in load_shipped_marker_sets()}
    set_of_name |= {name: each for each in load_shipped_marker_sets() for name in each.other_names}
    return find_by_name(name_or_path, set_of_name, "marker set", _read_marker_set)


def build_subject_marker_set(subject: Subject) -> MarkerSet:
    """Return a subject's markers as a set, with the aliases of the shipped set from which they are."""
    shipped = next((each for each in load_shipped_marker_sets() if each.name == subject.marker_set), None)
    aliases = dict(zip(shipped.labels, shipped.aliases, strict=True)) if shipped else {}
    return MarkerSet(
        name=subject.marker_set,
        title=shipped.title if shipped else subject.marker_set,
        skeleton="cmu31",
        labels=subject.labels,
        joints=subject.joints,
        marker_offsets=subject.marker_offsets,
        marker_spread=subject.marker_spread,
        aliases=tuple(aliases.get(label, ()) for label in subject.labels),
        optional_labels=shipped.optional_labels & set(subject.labels) if shipped else frozenset(),
        is_laboratory=shipped is not None and shipped.is_laboratory,
    )


def write_marker_set(path: str | Path, marker_set: MarkerSet, comment: str = "") -> None:
    """Write a marker set as YAML for `load_marker_set`, below a comment of any number of lines.

    Raises:
        WriteError: If the folder cannot be written to; an existing file then stays as it is.
    """
    joint_names = load_cmu31_body().skeleton.names
    markers: dict[str, InlineMapping] = {}
    for k, label in enumerate(marker_set.labels):
        markers[label] = InlineMapping(
            joint=joint_names[marker_set.joints[k]],
            offset=[round(float(x), MARKER_OFFSET_DECIMALS) for x in marker_set.marker_offsets[k]],
            spread=round(float(marker_set.marker_spread[k]), MARKER_OFFSET_DECIMALS),
        )
        if marker_set.aliases[k]:
            markers[label]["aliases"] = list(marker_set.aliases[k])
        if label in marker_set.optional_labels:
            markers[label]["optional"] = True
    data: dict[str, object] = {"name": marker_set.name, "title": marker_set.title}
    if marker_set.other_names:
        data["also_called"] = list(marker_set.other_names)
    data["skeleton"] = marker_set.skeleton
    if marker_set.is_laboratory:
        data["laboratory"] = True
    if marker_set.point_sd:
        data["point_sd"] = round(float(marker_set.point_sd), MARKER_OFFSET_DECIMALS)
    data["markers"] = markers
    if marker_set.props:
        data["props"] = {name: list(labels) for name, labels in marker_set.props.items()}
    comment_lines = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    with replace_atomically(Path(path)) as part:
        part.write_text(comment_lines + dump_yaml(data), encoding="utf-8", newline="\n")


def _read_marker_set(path: Path) -> MarkerSet:
    from mocapfix.io.yaml_files import MarkerSetModel, read_yaml_model

    model = read_yaml_model(MarkerSetModel, path)
    markers = model.markers.values()
    places = [_locate_marker(marker, f"{path}: markers.{label}.landmark") for label, marker in model.markers.items()]
    if small := [name for name, labels in model.props.items() if len(labels) < MIN_GROUP_MARKERS]:
        raise SceneError(f"{path}: props: {format_name_list(small)} has fewer than {MIN_GROUP_MARKERS} markers.")
    skeleton = load_cmu31_body().skeleton
    return MarkerSet(
        name=model.name,
        title=model.title,
        skeleton=model.skeleton,
        labels=tuple(model.markers),
        joints=np.array([skeleton.find_joint(place.joint_name) for place in places], int),
        marker_offsets=np.array([place.offset for place in places], float),
        marker_spread=np.array([place.spread for place in places], float),
        aliases=tuple(marker.aliases for marker in markers),
        optional_labels=frozenset(label for label, marker in model.markers.items() if marker.optional),
        other_names=model.also_called,
        point_sd=model.point_sd,
        props=model.props,
        is_laboratory=model.laboratory,
    )


def _locate_marker(marker: "SetMarkerModel", key: str) -> Landmark:
    """Return the place of a marker: that of its landmark, or its own joint, offset and spread."""
    if marker.landmark is None:
        assert marker.joint is not None
        assert marker.offset is not None
        assert marker.spread is not None
        return Landmark(marker.joint, np.array(marker.offset, float), marker.spread)
    try:
        landmark = find_landmark(marker.landmark)
    except ValueError as error:
        raise SceneError(f"{key}: {error}.") from error
    return landmark._replace(spread=marker.spread or landmark.spread)


UNASSIGNED_SUBJECT = "others"  # the name of the take of the markers that belong to no body, nor to a part of one


@dataclass(frozen=True)
class MarkerSetMatch:
    """The marker set that fits a take, None if none does, and a sentence with the reason."""

    marker_set: MarkerSet | None
    reason: str


def find_subject_prefixes(labels: Sequence[str], marker_set: MarkerSet | None = None) -> tuple[str, ...]:
    """Return what the labels of each subject begin with where it is no name with a colon: "Jim_" of "Jim_LFHD".

    "L_" of "L_ANKLE" is none: a prefix is the name of a subject only if what follows it shows a body or a part of one in a
    marker set, and if more markers are found in this way than by the whole labels.
    """
    if any(":" in label for label in labels):
        return ()
    sets = (*load_shipped_marker_sets(), *((marker_set,) if marker_set else ()))
    readings = index_labels_by_prefix(labels)
    whole_names = readings.pop("", {})
    found: list[str] = []
    for prefix, names in readings.items():
        if len(names) < MIN_SINGLE_LIMB_MARKERS:
            continue
        columns = set(names.values())
        whole = {name: column for name, column in whole_names.items() if column in columns}
        matches = [(each, each.match_names(names)) for each in sets]
        shown = max((len(match) for each, match in matches if match and not each.describe_missing_body(match)), default=0)
        if shown > max(len(each.match_names(whole)) for each in sets):
            found.append(prefix)
    return tuple(found)


def select_subject(take: Take, subject_prefix: str) -> Take:
    """Return the markers of one subject of a take, who is given by the beginning of the labels: "Jim" or "Jim:"."""
    subject_prefix = subject_prefix.strip().removesuffix(":")
    names = np.array([name.casefold() for name in take.marker_subjects], object)
    selected = np.flatnonzero(names == subject_prefix.casefold())
    if not subject_prefix or not len(selected):
        known = list(dict.fromkeys(name for name in take.marker_subjects if name))
        hint = f"its subjects are {format_name_list(known)}" if known else "its labels name no subjects"
        raise TakeError(f"{take.name}: has no subject {subject_prefix!r}; {hint}.")
    if len(selected) == len(names):
        return take
    part = take.extract_markers(selected, take.marker_subjects[selected[0]])
    note = f"Only the markers of {part.subject_name} were cleaned: the rest of the file is unchanged."
    return replace(part, notes=(*part.notes, note))


MIN_EXPLAINED_SHARE = 0.9  # of a take's labels that belong to a set of which it has few markers: others name some of them, too


def choose_marker_set(labels: Sequence[str]) -> MarkerSetMatch:
    """Return the shipped set that matches the most of a take's labels, among the sets that find a whole body in them.

    If there is none, it is the markers that the take has of a set to which nearly all its labels belong, if they locate a body;
    otherwise the set with the most markers on a part of a body. Among sets that match equally many, the one with the fewest
    missing markers is chosen. `MarkerSet.find_shown_sections` defines bodies and parts.
    """
    shipped = load_shipped_marker_sets()
    ranked = sorted(((each, each.match_labels(labels)) for each in shipped), key=lambda pair: _rank_match(*pair), reverse=True)
    best = next((each for each, found in ranked if not each.describe_incomplete_body(found)), None)
    if not best:
        reduced = [each.select_markers(found) for each, found in ranked if len(found) >= MIN_EXPLAINED_SHARE * len(labels)]
        best = next((each for each in reduced if not each.describe_incomplete_body(each.labels)), None)
    if not best:
        parts = [(each, each.select_shown_part(found), found) for each, found in ranked]
        ranks = [(_rank_match(part, set(found).intersection(part.labels)), each) for each, part, found in parts if part.labels]
        best = max(ranks, key=lambda pair: pair[0])[1] if ranks else None
    if best:
        return MarkerSetMatch(best, describe_marker_set_match(best, labels))
    nearest, found = ranked[0]
    if found:
        reason = f"the nearest is {nearest.name} with {_format_match_count(nearest, found)}, but "
        reason += nearest.describe_missing_body(found, max_listed=0)
    else:
        reason = "none of them is in a shipped set; `mocapfix marker-set list` shows these"
    return MarkerSetMatch(None, f"No marker set fits the labels {format_name_list(labels, MAX_LISTED_LABELS)}: {reason}.")


def describe_marker_set_match(marker_set: MarkerSet, labels: Sequence[str]) -> str:
    """Return a sentence with the number of markers of a set that are among a take's labels."""
    return f"{marker_set.title}: {_format_match_count(marker_set, marker_set.match_labels(labels))} were found."


def _rank_match(marker_set: MarkerSet, found_labels: Collection[str]) -> tuple[int, int]:
    return len(found_labels), -len(marker_set.list_missing_labels(found_labels))


def _format_match_count(marker_set: MarkerSet, found_labels: Collection[str]) -> str:
    required_count = len(marker_set.required_labels)
    found_required_count = required_count - len(marker_set.list_missing_labels(found_labels))
    found_optional_count = len(found_labels) - found_required_count
    optional = f" and {found_optional_count} optional ones" if found_optional_count else ""
    return f"{found_required_count} of its {required_count} markers{optional}"


NO_BODY_NOTE = "The take was cleaned without a skeleton: there is no BVH."


@dataclass(frozen=True)
class SubjectChoice:
    """The subject and the marker set of a take."""

    subject: Subject | None  # the subject that the options name, None if it is to be calibrated
    marker_set: MarkerSet | None  # the marker set, None where no set fits: there is no body then
    notes: tuple[str, ...] = ()  # sentences for the report
    is_learned: bool = False  # whether the marker set was learned from the take itself


def load_requested_subject(options: SubjectOptions) -> SubjectChoice:
    """Return the subject and the marker set that the options name, None for each that they do not name."""
    subject = None if isinstance(options.subject, tuple) else options.subject
    if subject is not None:
        if isinstance(subject, str | Path):
            subject = read_subject(subject)
        return SubjectChoice(subject, build_subject_marker_set(subject), subject.notes)
    return SubjectChoice(None, None if options.marker_set is None else load_marker_set(options.marker_set))


def resolve_subject(take: Take, options: SubjectOptions) -> SubjectChoice:
    """Return the subject and the marker set of one subject's take: those that the options name, or the set that its labels match.

    Raises:
        TakeError: Where the named set or subject does not fit the take.
    """
    if take.subject_name == UNASSIGNED_SUBJECT:
        return SubjectChoice(None, None, ("Markers that form neither a body nor a part of one are cleaned without a skeleton.",))
    requested = load_requested_subject(options)
    marker_set = requested.marker_set
    if marker_set is None:
        match = choose_marker_set(take.labels)
        notes = () if match.marker_set else (match.reason, NO_BODY_NOTE)
        return restrict_subject_choice(SubjectChoice(None, match.marker_set, notes), take.labels)
    found = marker_set.match_labels(take.labels)
    if missing := marker_set.describe_missing_body(found):
        count = f"{len(found)} of its {len(marker_set.labels)} markers"
        raise TakeError(f"{take.name}: {marker_set.name} does not fit: {count}, {missing}.")
    return restrict_subject_choice(requested, take.labels)


def restrict_subject_choice(choice: SubjectChoice, labels: Sequence[str]) -> SubjectChoice:
    """Return the choice with the markers of the joints that a take with these labels shows."""
    if choice.marker_set is None:
        return choice
    marker_set = choice.marker_set.select_shown_part(choice.marker_set.match_labels(labels))
    subject = choice.subject
    if marker_set is choice.marker_set or not marker_set.labels:
        return choice
    return replace(choice, marker_set=marker_set, subject=subject.select_markers(marker_set.labels) if subject else None)


def withdraw_marker_set(choice: SubjectChoice) -> SubjectChoice:
    """Return the choice without its learned marker set, and with the reason."""
    reason = "A marker set learned from this take would reject or relabel measured samples, so it is not used."
    return replace(choice, marker_set=None, is_learned=False, notes=(*choice.notes[:1], reason, NO_BODY_NOTE))
