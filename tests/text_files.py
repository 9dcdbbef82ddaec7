"""Text files of marker takes in the layout of each vendor, for tests of readers and patches."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import ReadError

LABELS = ("Jim:LFHD", "Jim:LANK", "Jim:LFIN")
# One person standing in mm, Z up: head, ankle, hand over four frames.
STANDING = np.array([[[10, 20, 1700], [0.5, 30, 80], [400, 20.5, 1000]]], float) + np.arange(4)[:, None, None]


def cells(row: np.ndarray, missing: str = "", decimals: int = 3) -> list[str]:
    """Return the coordinates of a frame (P, 3) as fields."""
    return [missing if np.isnan(x) else f"{x:.{decimals}f}" for x in row.ravel()]


def trc(
    xyz: np.ndarray = STANDING,
    labels: Sequence[str] = LABELS,
    first: int = 1,
    rate: float = 100,
    units: str = "mm",
    missing: str = "",
    end: str = "\r\n",
    blank: bool = True,
    between: str = "\t",
    **header_values: object,
) -> str:
    """Return a TRC of `xyz` (T, P, 3); `header_values` replaces values of the header by key."""
    header: dict[str, object] = {"DataRate": f"{rate:.2f}", "CameraRate": f"{rate:.2f}", "NumFrames": len(xyz)}
    header |= {"NumMarkers": len(labels), "Units": units, "OrigDataRate": rate, "OrigDataStartFrame": 1}
    header |= {"OrigNumFrames": len(xyz)}
    header |= header_values
    lines = [["PathFileType", "4", "(X/Y/Z)", "walk.trc"], list(header), [str(value) for value in header.values()]]
    lines.append(["Frame#", "Time", *(cell for label in labels for cell in (label, "", ""))])
    lines.append(["", "", *(f"{axis}{i + 1}" for i in range(len(labels)) for axis in "XYZ")])
    lines += [[""]] if blank else []
    lines += [[str(first + t), f"{t / rate:.5f}", *cells(row, missing)] for t, row in enumerate(xyz)]
    return end.join(between.join(line) for line in lines) + end


def motive(
    xyz: np.ndarray = STANDING[..., [1, 2, 0]] / 1000,
    labels: Sequence[str] = LABELS,
    kinds: Sequence[str] | None = None,
    units: str = "Meters",
    space: str = "Global",
    labelled_rows: bool = True,
    first: int = 0,
    rate: float = 120,
) -> str:
    """Return a Motive CSV 1.2x: a rigid body with quaternion and error, then a column for each coordinate of the markers."""
    kinds = kinds or ["Marker"] * len(labels)
    header = ["Format Version", "1.23", "Take Name", '"Walk, first"', "Capture Frame Rate", "240.000000"]
    header += ["Export Frame Rate", f"{rate:.6f}", "Total Exported Frames", str(len(xyz)), "Rotation Type", "Quaternion"]
    header += ["Length Units", units, "Coordinate Space", space]
    body = 8
    kind = ["Rigid Body"] * body + [each for each in kinds for _ in range(3)]
    name = ["Box"] * body + [each for each in labels for _ in range(3)]
    number = ["1"] * body + [f"{i}" for i in range(len(labels)) for _ in range(3)]
    what = ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"] + ["Position"] * (3 * len(labels))
    axes = [*"XYZWXYZ", "", *("XYZ" * len(labels))]
    head = [("Type", kind), ("Name", name), ("ID", number), ("", what)]
    lines = [header, [], *(["", what_row if labelled_rows else "", *row] for what_row, row in head)]
    lines.append(["Frame", "Time (Seconds)", *axes])
    pose = ["0.1", "0.2", "0.3", "0.9", "1.5", "0.7", "-0.2", "0.0004"]
    lines += [[str(first + t), f"{t / rate:.6f}", *pose, *cells(row, "", 6)] for t, row in enumerate(xyz)]
    return "\r\n".join(",".join(line) for line in lines) + "\r\n"


def nexus(
    xyz: np.ndarray = STANDING,
    labels: Sequence[str] = LABELS,
    first: int = 695,
    rate: str = "120",
    before: str = "",
    after: str = "",
    units: str = "mm",
    velocities: bool = False,
) -> str:
    """Return a Nexus CSV with sections before and after its trajectories."""
    axes = ["X", "Y", "Z", "X'", "Y'", "Z'"] if velocities else ["X", "Y", "Z"]
    more = [""] * (len(axes) - 1)
    lines = [["Trajectories"], [rate], ["", "", *(cell for label in labels for cell in (label, *more))]]
    lines.append(["Frame", "Sub Frame", *(axes * len(labels))])
    lines.append(["", "", *([units] * (len(axes) * len(labels)))])
    for t, row in enumerate(xyz):
        points = [[*cells(point), *(["5.0"] * 3 if velocities else [])] for point in row]
        lines.append([str(first + t), "0", *(cell for point in points for cell in point)])
    return before + "\n".join(",".join(line) for line in lines) + "\n" + after


def workstation(xyz: np.ndarray = STANDING, labels: Sequence[str] = LABELS) -> str:
    """Return an ASCII export of Vicon Workstation, the predecessor of Nexus."""
    lines = [["Title"], ["Date:"], [""], ["TRAJECTORIES"], ["100", "Hz"], ["", *(c for label in labels for c in (label, "", ""))]]
    lines.append(["Field #", *("XYZ" * len(labels))])
    lines += [[str(1 + t), *cells(row)] for t, row in enumerate(xyz)]
    return "\n".join(",".join(line) for line in lines) + "\n"


def qualisys(
    xyz: np.ndarray = STANDING,
    labels: Sequence[str] = LABELS,
    columns: Sequence[str] = ("Frame", "Time"),
    named: bool = True,
    missing: str = "0.000",
    trailing: str = "",
    first: int = 1,
) -> str:
    """Return a QTM TSV with `columns` before those of the markers, and a line of column names if `named`."""
    header = [["NO_OF_FRAMES", str(len(xyz))], ["NO_OF_CAMERAS", "10"], ["NO_OF_MARKERS", str(len(labels))], ["FREQUENCY", "100"]]
    header += [["TIME_STAMP", "2026-01-19, 10:19:43.755", "2063631.9"], ["DATA_INCLUDED", "3D"], ["EVENT", "jump", "3", "0.02"]]
    lines = [*header, ["MARKER_NAMES", *labels]]
    lines += [[*columns, *(f"{label} {axis}" for label in labels for axis in "XYZ")]] if named else []
    for t, row in enumerate(xyz):
        lead = {"Frame": str(first + t), "Time": f"{(first - 1 + t) / 100:.5f}"}
        lines.append([*(lead[each] for each in columns), *cells(row, missing)])
    return "\r\n".join("\t".join(line) + trailing for line in lines) + "\r\n"


def motive_rows(xyz: np.ndarray, names: Sequence[str], hand: str = "righthanded", bodies: int = 1) -> str:
    """Return an OptiTrack CSV 1.1, which lists the visible markers of each frame."""
    lines = ['comment,"OptiTrack Export Data"', hand, "info,version,1.1", f"info,framecount,{len(xyz)}"]
    for t, row in enumerate(xyz):
        there = [f"{x:.8f},{y:.8f},{z:.8f},{40 + i},{names[i]}" for i, (x, y, z) in enumerate(row) if not np.isnan(x)]
        body = [",".join(["1", *["0.5"] * 10])] * bodies
        lines.append(",".join(["frame", str(t), f"{t / 120:.8f}", str(bodies), *body, str(len(there)), *there]))
        lines.append(f'rigidbody,{t},{t / 120:.8f},"Rigid Body 1",1,0,0')
    return "\r\n".join(lines) + "\r\n"


def assert_refused(read: Callable[[Path, str], object], folder: Path, text: str, words: str) -> None:
    """Check that reading a text is refused with a message that names the file and contains `words`."""
    with pytest.raises(ReadError) as error:
        read(folder, text)
    assert str(error.value).startswith(str(folder / "walk."))
    assert words in str(error.value)
    assert "\n" not in str(error.value)
