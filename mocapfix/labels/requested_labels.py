"""Labels for a take that has none with a meaning: of the named set or person, of the shipped set that fits clearly, or numbers.

Labels without a meaning are those that programs number (M01, Marker_17), or that are in no marker set and have no known word.

The points of the file are labelled, and its labelled copy is read again. Where each trajectory is one marker, only its name is
replaced. Otherwise each marker gets a column of its own, before the other columns, to which its samples move with all of their
words, and trajectories without samples are left out. A text table is written again, in the unit and axes of the old one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import TakeError, format_name_list
from mocapfix.io import patches, text_tables
from mocapfix.io.c3d_parameters import read_c3d_parameters, replace_point_parameters
from mocapfix.io.capture import read_capture, read_capture_bytes
from mocapfix.io.conventions import change_convention
from mocapfix.io.file_content import read_file_bytes
from mocapfix.io.files import make_scratch_folder
from mocapfix.io.points import NUMBERED_POINT_NAME
from mocapfix.io.source_file import build_truncated_error, open_source
from mocapfix.labels.label_summary import CERTAIN_LABEL_CONFIDENCE, describe_labelling
from mocapfix.labels.labeller import assume_marker_set, describe_better_set, label_people, label_points, separate_people
from mocapfix.labels.reference_labeller import build_reference_markers, join_trajectories, label_points_like
from mocapfix.labels.tracklets import PointLabels, UnlabelledPoints, are_points_unordered, find_tracklets
from mocapfix.model.animation import Animation
from mocapfix.model.marker_set import MarkerSet, fold_label
from mocapfix.model.subject import Subject
from mocapfix.model.take import C3dLayout, Take
from mocapfix.options import DEFAULT_READ_OPTIONS, CleanOptions, ReadOptions
from mocapfix.subject import library
from mocapfix.subject.label_words import guess_marker_set_from_words

MAX_KNOWN_WORD_SHARE = 0.1  # of labels with words for places, up to which labels have no meaning; some words are short
MAX_STEM_SHARE = 0.1  # number of different labels without their digits up to which labels are numbers, as a share of the labels


def are_labels_arbitrary(labels: Sequence[str], marker_set: MarkerSet) -> bool:
    """Return whether the labels of a take mean nothing, so that its trajectories must be labelled to be those of a marker set.

    This is so if neither the set nor a shipped one finds a body in the labels, and they are numbered or have no known words.
    """
    if not labels or not marker_set.describe_missing_body(marker_set.match_labels(labels)):
        return False
    if library.choose_marker_set(labels).marker_set is not None:
        return False
    names = [label.rpartition(":")[2] for label in labels]
    if len({fold_label(name).strip("0123456789") for name in names}) <= max(1.0, MAX_STEM_SHARE * len(names)):
        return True
    return len(guess_marker_set_from_words(names).labels) <= MAX_KNOWN_WORD_SHARE * len(names)


NO_FILE = Path("labelled")  # in messages, in place of a file that is not yet written


@dataclass(frozen=True)
class LabelledColumns:
    """P columns of a labelled file."""

    labels: tuple[str, ...]  # their labels
    source_points: Int[np.ndarray, "T P"]  # index of the file's point from which each sample comes, -1 for a missing sample
    moves_samples: bool  # whether any sample gets another column; if not, the points are those of the file


def plan_columns(
    point_labels: list[str],
    columns: Int[np.ndarray, " C"],
    marker_indices: Int[np.ndarray, "T C"],
    is_visible: np.ndarray,
    labels: tuple[str, ...],
) -> LabelledColumns:
    """Return the columns of a labelled file.

    Args:
        columns: Indices of the unlabelled points among them.
        marker_indices: Index of the marker to which each of their samples belongs, -1 for none.
        is_visible: (T, C) which samples are present.
    """
    frame_count = len(marker_indices)
    own = [np.unique(marker_indices[is_visible[:, c], c]) for c in range(len(columns))]
    single = [int(each[0]) for each in own if len(each) == 1 and each[0] >= 0]
    identity = np.arange(len(point_labels))
    if all(len(each) <= 1 for each in own) and len(set(single)) == len(single):
        names = list(point_labels)
        for point, each in zip(columns.tolist(), own, strict=True):
            if len(each) and each[0] >= 0:
                names[point] = labels[each[0]]
        return LabelledColumns(tuple(names), np.tile(identity, (frame_count, 1)), moves_samples=False)
    found = np.unique(marker_indices[is_visible & (marker_indices >= 0)])
    sources = np.full((frame_count, len(found)), -1)
    rows, places = np.nonzero(is_visible & (marker_indices >= 0))
    sources[rows, np.searchsorted(found, marker_indices[rows, places])] = columns[places]
    rest = np.where(is_visible & (marker_indices < 0), columns, -1)
    kept = (rest >= 0).any(0)
    others = np.setdiff1d(identity, columns)
    return LabelledColumns(
        (*(labels[m] for m in found), *(point_labels[p] for p in others), *(point_labels[p] for p in columns[kept])),
        np.concatenate([sources, np.tile(others, (frame_count, 1)), rest[:, kept]], axis=1),
        moves_samples=True,
    )


def build_labelled_c3d(take: Take, columns: LabelledColumns) -> bytes:
    """Return the bytes of a take's C3D with other columns. Raises WriteError if the file cannot be read any more."""
    layout = take.layout
    assert isinstance(layout, C3dLayout)
    with open_source(NO_FILE, take.path) as file:
        data = file.read()
    stop_byte = layout.data_start_byte + layout.frame_count * layout.frame_stride_bytes
    if len(data) < stop_byte:
        raise build_truncated_error(take.path)
    head = replace_point_parameters(data[: layout.data_start_byte], columns.labels, has_same_points=not columns.moves_samples)
    if not columns.moves_samples:
        return head + data[layout.data_start_byte :]
    return head + _build_frames(layout, data, columns.source_points) + data[stop_byte:]


def _build_frames(layout: C3dLayout, data: bytes, source_points: Int[np.ndarray, "T P"]) -> bytes:
    """Return the data section with other points; the analog samples of each frame are unchanged."""
    moved = layout.view_words(data)[np.arange(layout.frame_count)[:, None], source_points]
    moved[source_points < 0] = patches.encode_samples(layout, np.array([patches.MISSING_SAMPLE]))[0]
    point_bytes = np.ascontiguousarray(moved).view(np.uint8).reshape(layout.frame_count, -1)
    old_point_bytes = layout.point_count * 4 * layout.word_size_bytes
    shape = layout.frame_count, layout.frame_stride_bytes - old_point_bytes
    analog = np.ndarray(shape, np.uint8, data, layout.data_start_byte + old_point_bytes, (layout.frame_stride_bytes, 1))
    return np.concatenate([point_bytes, analog], axis=1).tobytes()


def build_labelled_table(take: Take, positions: Float[np.ndarray, "T P 3"], labels: tuple[str, ...]) -> bytes:
    """Return the bytes of a new text table: a TRC for a TRC, else a plain CSV. Positions are in metres, Y up."""
    nothing = {"unlabelled": None, "computed_points": None, "point_columns": np.zeros(0, int)}
    labelled = replace(take, markers=positions, labels=labels, **nothing)
    write = text_tables.write_trc if take.path and take.path.suffix.lower() == ".trc" else text_tables.write_csv
    with make_scratch_folder() as folder:
        path = folder / "labelled"
        write(path, labelled)
        return path.read_bytes()


@dataclass(frozen=True)
class FilePoints:
    """The points of a take that have no labels, or labels without a meaning."""

    positions: Float[np.ndarray, "T C 3"]  # metres, Y up, NaN where missing
    columns: Int[np.ndarray, " C"]  # their indices among the points of the file
    replaced_labels: tuple[str, ...] = ()  # the labels without a meaning; empty if the points have none
    read_options: ReadOptions = DEFAULT_READ_OPTIONS  # those with which the file was read


def collect_unlabelled_points(take: Take) -> FilePoints | None:
    """Return the points of a take in which no point has a label, None for any other take."""
    if not all(label.startswith(f"{NUMBERED_POINT_NAME} ") for label in take.labels):
        return None
    parts = [each for each in (take if take.labels else None, take.unlabelled) if each is not None]
    if not parts:
        return None
    positions = np.concatenate([each.markers for each in parts], axis=1)
    return FilePoints(positions, np.concatenate([each.point_indices for each in parts]))


def find_file_tracklets(points: FilePoints, rate: float) -> UnlabelledPoints:
    """Divide the points of a take into tracklets; a trajectory with a label is one."""
    if not points.replaced_labels or are_points_unordered(points.positions):
        return find_tracklets(points.positions, rate)
    visible = ~np.isnan(points.positions[..., 0])
    number = np.argsort(np.argsort(np.where(visible.any(0), visible.argmax(0), len(visible)), kind="stable"), kind="stable")
    return UnlabelledPoints(points.positions, np.where(visible, number, -1), rate)


def apply_labels(take: Take, points: FilePoints, point_labels: PointLabels, labels: tuple[str, ...]) -> Take:
    """Return the take as it is read from its file with labels."""
    is_visible = ~np.isnan(points.positions[..., 0])
    columns = plan_columns(list_point_names(take), points.columns, point_labels.marker_indices, is_visible, labels)
    if isinstance(take.layout, C3dLayout):
        data = build_labelled_c3d(take, columns)
    else:
        parts = _list_parts(take)
        points_of_file = np.concatenate([part.point_indices for part in parts])
        positions = np.moveaxis(np.concatenate([part.markers for part in parts], axis=1), -1, 0)
        gathered = np.stack([_gather(points_of_file, coordinate, columns) for coordinate in positions], axis=-1)
        data = build_labelled_table(take, gathered, columns.labels)
    assert take.path is not None
    labelled = read_capture_bytes(take.path, data, replace(points.read_options, accept_contradictions=True))
    assert isinstance(labelled, Take)
    assert take.layout is not None
    labelled = change_convention(labelled, take.layout.unit_m, take.layout.rotation_y_up_file, take.up_axis)
    known_confidence = np.where(point_labels.marker_indices >= 0, point_labels.confidence, np.nan)
    confidence = _gather(points.columns, known_confidence, columns)[:, labelled.point_indices]
    return replace(labelled, labelled_file=data, label_confidence=confidence)


def list_point_names(take: Take) -> list[str]:
    """Return the labels of all points of a take's file, in the order of the file."""
    if isinstance(take.layout, C3dLayout):
        assert take.path is not None
        names = list(read_c3d_parameters(read_file_bytes(take.path)).labels)[: take.layout.point_count]
        return names + [""] * (take.layout.point_count - len(names))
    parts = _list_parts(take)
    names = [""] * (1 + max(int(each.point_indices.max(initial=0)) for each in parts))
    for part in parts:
        for point, label in zip(part.point_indices.tolist(), part.labels, strict=True):
            names[point] = label
    return names


def _list_parts(take: Take) -> list[Take]:
    """Return the points of a take: its markers, its unlabelled trajectories and its computed points."""
    return [each for each in (take, take.unlabelled, take.computed_points and take.computed_points.take) if each is not None]


def _gather(points: Int[np.ndarray, " C"], values: Float[np.ndarray, "T C"], columns: LabelledColumns) -> np.ndarray:
    """Return values (T, P) in the columns of a labelled file, given those of some points of the file by their indices."""
    place = np.full(int(max(columns.source_points.max(), points.max())) + 2, -1)
    place[points] = np.arange(len(points))
    sources = place[columns.source_points]
    is_known: Bool[np.ndarray, "T P"] = (sources >= 0) & (columns.source_points >= 0)
    return np.where(is_known, np.take_along_axis(values, np.maximum(sources, 0), axis=1), np.nan)


MIN_CERTAIN_SHARE = 0.9  # share of the points that must get certain labels of a set that the user did not name
MIN_NAMED_SET_EVIDENCE = 0.5  # per marker, below which points show no person with a named set; right sets have 1.8 to 3.7
MAX_COMMON_LABEL_SHARE = 0.1  # share of the labels of a take up to which labels that another take has as well are a coincidence
MIN_REFERENCE_SHARE = 0.1  # share of the frames in which a labelled take shows the markers that are looked for
MIN_FOUND_MARKER_SHARE = 0.5  # share of these markers that must be found
MIN_JOINED_SHARE = 0.8  # share of the points that must be joined to markers where no set is known
MAX_LISTED_ARBITRARY_LABELS = 3  # labels without a meaning that a sentence lists


def label_capture(
    take: Take, options: CleanOptions, calibrate: Callable[[Sequence[Path], CleanOptions], Subject]
) -> tuple[Take, CleanOptions]:
    """Return the take with labels if it has none, and the options with the subject of the labelled take that they name.

    Args:
        options: `options.subject` names a marker set, a subject or a labelled take.
        calibrate: Returns the subject of labelled takes.

    Raises:
        TakeError: As `label_take`, or where the options name a labelled take and a marker set or a subject.
    """
    requested = options.subject
    if requested.like is not None:
        if requested.subject is not None or requested.marker_set is not None:
            raise TakeError("--like takes the markers and the person from a take; leave out --marker-set and --subject.")
        labelled = label_take_like(take, Path(requested.like), options.read)
        if labelled is not None:
            return labelled, options.change(like=None)
        options = options.change(subject=calibrate([Path(requested.like)], CleanOptions(read=options.read)), like=None)
    return label_take(take, library.load_requested_subject(options.subject), options.read), options


def label_take(take: Take, request: library.SubjectChoice, read_options: ReadOptions) -> Take:
    """Return a take with labels if its points have none, or none with a meaning, and with the prefixes of its subjects.

    They are those of the marker set or the subject that the user names, or else of the shipped set that fits clearly. Where none
    does, fragments of the same markers are joined and numbered, and a take whose points cannot be joined, or are joined already,
    is returned as it is. Labels without a meaning are replaced only by those of a set or a subject that the user names.

    Raises:
        TakeError: If the points of a take without any label cannot be joined, or no person with the markers of a set that the
            user names is found.
    """
    take = replace(take, subject_prefixes=library.find_subject_prefixes(take.labels, request.marker_set))
    points = collect_unlabelled_points(take)
    if points is None:
        if request.marker_set is None or not are_labels_arbitrary(take.labels, request.marker_set):
            return take
        points = FilePoints(take.markers, take.point_indices, take.labels)
    points = replace(points, read_options=read_options)
    count = points.positions.shape[1]
    tracklets = find_file_tracklets(points, take.rate)
    if request.marker_set is None:
        labelled, reason = label_by_assumed_set(take, points, tracklets)
        labelled = labelled or join_and_number(take, points, tracklets, reason)
        if labelled is None and not take.labels:
            raise TakeError(
                f"{take.name}: none of its {count} points has a label; name the markers with --marker-set, the person with "
                f"--subject, or a labelled take of the person with --like. {reason}"
            )
        return labelled or replace(take, notes=(*take.notes, reason))
    if request.subject is None:
        labels = label_people(tracklets, request.marker_set)
    else:
        labels = label_points(tracklets, request.marker_set, request.subject)
    if not (labels.marker_indices >= 0).any() or labels.evidence_per_marker < MIN_NAMED_SET_EVIDENCE:
        raise TakeError(
            f"{take.name}: no person with the markers of {request.marker_set.name} was found in its {count} points; "
            "check the marker set, the unit and the up axis (--up)."
        )
    labelled = _apply_labels_of_set(take, points, labels, request.marker_set)
    if request.subject is None and not labels.subject_indices.size:
        candidates = _load_candidates()
        if warning := describe_better_set(tracklets, labels, request.marker_set, candidates):
            return replace(labelled, notes=(warning, *labelled.notes))
    return labelled


def label_take_like(take: Take, path: Path, options: ReadOptions) -> Take | None:
    """Return a take without labels with those of a labelled take of the same person whose markers are in no shipped set.

    Returns None where the take has labels that may be those of the other one, or where a shipped set fits that.
    """
    other = read_capture(path, options)
    if isinstance(other, Animation) or collect_unlabelled_points(other) or library.choose_marker_set(other.labels).marker_set:
        return None
    points = collect_unlabelled_points(take)
    if points is None:
        if len(set(take.labels).intersection(other.labels)) > MAX_COMMON_LABEL_SHARE * len(take.labels):
            return None
        points = FilePoints(take.markers, take.point_indices, take.labels)
    shown = np.flatnonzero((other.visible & other.measured).mean(0) >= MIN_REFERENCE_SHARE)
    labels = tuple(other.labels[m] for m in shown)
    reference = build_reference_markers(other.masked(other.measured).markers[:, shown], labels)
    found = label_points_like(find_file_tracklets(points, take.rate), reference)
    count = len(np.unique(found.marker_indices[found.marker_indices >= 0]))
    if count < MIN_FOUND_MARKER_SHARE * len(labels):
        raise TakeError(
            f"{take.name}: only {count} of the {len(labels)} markers of {other.name} were found in its points; "
            "check that both takes show the same person with the same markers."
        )
    labelled = apply_labels(take, replace(points, read_options=options), found, labels)
    bare_labels = tuple(label.rpartition(":")[2] for label in labels)
    note = f"No shipped marker set fits {other.name}: the points were labelled by the distances of its markers."
    return replace(labelled, notes=(*labelled.notes, note, *describe_labelling(labelled, bare_labels)))


def label_by_assumed_set(take: Take, points: FilePoints, tracklets: UnlabelledPoints) -> tuple[Take | None, str]:
    """Return the take with the labels of the shipped set that fits its points clearly, None if there is none, and the reason."""
    marker_set, reason = assume_marker_set(tracklets, _load_candidates())
    if marker_set is None:
        return None, reason
    labels = label_points(tracklets, marker_set)
    is_certain = (labels.marker_indices >= 0) & (labels.confidence >= CERTAIN_LABEL_CONFIDENCE)
    share = float(is_certain.sum() / max(1, (tracklets.tracklet_indices >= 0).sum()))
    if share < MIN_CERTAIN_SHARE:
        nearest = f"The nearest shipped marker set is {marker_set.name}"
        return None, f"{nearest}, but only {share:.0%} of the points get certain labels."
    labelled = _apply_labels_of_set(take, points, labels, marker_set)
    return replace(labelled, notes=(reason, *labelled.notes)), reason


def join_and_number(take: Take, points: FilePoints, tracklets: UnlabelledPoints, reason: str) -> Take | None:
    """Return the take with the fragments of each marker joined, where no set is known; None if there is little to join."""
    largest = int((tracklets.tracklet_indices >= 0).sum(axis=1).max(initial=0))
    if take.labels and points.positions.shape[1] <= largest and not are_points_unordered(points.positions):
        return None
    labels, names = join_trajectories(tracklets, label_points_like)
    share = float((labels.marker_indices >= 0).sum() / max(1, (tracklets.tracklet_indices >= 0).sum()))
    if share < MIN_JOINED_SHARE:
        return None
    labelled = apply_labels(take, points, labels, names)
    note = f"{reason} The trajectories of each marker were joined by how markers move together: {names[0]} to {names[-1]}."
    return replace(labelled, notes=(*labelled.notes, note, *describe_labelling(labelled, names)))


def _load_candidates() -> list[MarkerSet]:
    """Return the shipped sets of markers, without those of keypoints."""
    return [each for each in library.load_shipped_marker_sets() if not each.point_sd]


def _apply_labels_of_set(take: Take, points: FilePoints, labels: PointLabels, marker_set: MarkerSet) -> Take:
    labelled = apply_labels(take, points, *separate_people(labels, marker_set.labels))
    notes = list(describe_labelling(labelled, marker_set.required_labels))
    if points.replaced_labels:
        names = format_name_list(points.replaced_labels, MAX_LISTED_ARBITRARY_LABELS)
        note = f"The labels {names} mean nothing in {marker_set.name}: the trajectories were labelled by their positions."
        notes.insert(0, note)
    return replace(labelled, notes=(*labelled.notes, *notes))


def label_unlabelled(take: Take, labels: PointLabels, names: Sequence[str], read_options: ReadOptions) -> Take:
    """Return a take whose unlabelled trajectories have labels, without the name of the subject, and those of its markers."""
    assert take.unlabelled is not None
    points = FilePoints(take.unlabelled.markers, take.unlabelled.point_indices, read_options=read_options)
    prefix = take.labels[0].removesuffix(take.bare_labels[0]) if take.labels else ""
    labelled = apply_labels(take, points, labels, tuple(prefix + name for name in names))
    labelled = replace(labelled, subject_prefixes=take.subject_prefixes)
    return replace(labelled, notes=(*labelled.notes, *describe_labelling(labelled, tuple(names))))


def describe_missing_labels(take: Take, result: Take) -> str:
    """Return why `label_take` gave a take no labels and returned it as `result`."""
    if collect_unlabelled_points(take) is not None:
        return f"{take.name}: {result.notes[-1]} Name the markers with --marker-set, the person with --subject, or --like."
    names = format_name_list(take.labels, MAX_LISTED_ARBITRARY_LABELS)
    return (
        f"{take.name}: has labels already ({names}); `mocapfix clean` finds those that are wrong. Labels that mean nothing, such "
        "as M01, are replaced if --marker-set, --subject or --like names the markers."
    )
