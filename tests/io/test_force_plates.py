"""Vertical forces of force plates: known forces of all four types, those that ezc3d computes, and incomplete descriptions."""

from pathlib import Path

import ezc3d
import numpy as np
import pytest

from mocapfix.io.capture import read_take
from mocapfix.io.force_plates import ForcePlate, read_force_plates
from mocapfix.options import ReadOptions
from tests.c3d_files import get_layout
from tests.captures import CAPTURES, needs_captures

C3D_CAPTURES = CAPTURES / "c3d"
FRAMES, SAMPLES_PER_FRAME, RATE = 40, 10, 100.0
CORNERS_MM = np.array([[0, 0, 0], [600, 0, 0], [600, 400, 0], [0, 400, 0]], float)
CHANNEL_COUNTS = {1: 6, 2: 6, 3: 8, 4: 6}
INTEGER, FLOAT = 2, 4
"""types of parameters in ezc3d"""
LOAD_N = 700.0
LOADED = slice(100, 300)


def write_plates(
    path: Path, kinds: tuple[int, ...], zero: tuple[int, int] = (1, 0), baseline_n: float = 0.0, removed: str = ""
) -> None:
    """Write a C3D with plates of these types that bear LOAD_N downwards in the samples LOADED, without one parameter."""
    rng = np.random.default_rng(0)
    counts = [CHANNEL_COUNTS[kind] for kind in kinds]
    analog = rng.normal(0, 1, (sum(counts), FRAMES * SAMPLES_PER_FRAME))
    matrices, first = [], 0
    for kind, count in zip(kinds, counts, strict=True):
        load = np.zeros(FRAMES * SAMPLES_PER_FRAME)
        load[LOADED] = -LOAD_N
        matrix = np.eye(6)
        if kind == 3:
            analog[first + 4 : first + 8] = load / 4
        elif kind == 4:
            matrix = np.linalg.qr(rng.normal(size=(6, 6)))[0] * 2
            forces = np.zeros((6, len(load)))
            forces[2] = load
            analog[first : first + 6] = np.linalg.solve(matrix, forces)
        else:
            analog[first + 2] = load
        analog[first : first + count] += baseline_n
        matrices.append(matrix)
        first += count
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [RATE]
    file["parameters"]["POINT"]["LABELS"]["value"] = ["LHEE", "RHEE", "LTOE"]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["ANALOG"]["RATE"]["value"] = [RATE * SAMPLES_PER_FRAME]
    file["parameters"]["ANALOG"]["LABELS"]["value"] = [f"A{k}" for k in range(len(analog))]
    file["parameters"]["ANALOG"]["UNITS"]["value"] = ["N"] * len(analog)
    points = np.ones((4, 3, FRAMES))
    points[:3] = rng.normal(500, 100, (3, 3, FRAMES))
    file["data"]["points"] = points
    file["data"]["analogs"] = analog[None]
    channels = np.zeros((max(counts), len(kinds)))
    first = 1
    for column, count in enumerate(counts):
        channels[:count, column] = np.arange(first, first + count)
        first += count
    values = {
        "USED": [len(kinds)],
        "TYPE": list(kinds),
        "ZERO": list(zero),
        "CORNERS": np.stack([CORNERS_MM.T] * len(kinds), axis=2),
        "ORIGIN": np.zeros((3, len(kinds))),
        "CHANNEL": channels,
        "CAL_MATRIX": np.stack(matrices, axis=2),
    }
    group = file["parameters"]["FORCE_PLATFORM"]
    for name, value in values.items():
        is_whole = name in ("USED", "TYPE", "ZERO", "CHANNEL")
        array = np.asarray(value).astype(int if is_whole else float)
        group[name] = {"type": INTEGER if is_whole else FLOAT, "value": array, "description": "", "is_locked": False}
    if removed:
        group.pop(removed)
    file.write(str(path))


def read(path: Path, rate_hz: float | None = None) -> list[ForcePlate]:
    """Return the plates of a file."""
    take = read_take(path, ReadOptions(up_axis="Z", rate_hz=rate_hz))
    return read_force_plates(path.read_bytes(), get_layout(take), take.rate)


def test_the_rate_of_the_take_counts(tmp_path):
    write_plates(tmp_path / "plates.c3d", (1,))
    assert read(tmp_path / "plates.c3d", rate_hz=2 * RATE)[0].rate == 2 * RATE * SAMPLES_PER_FRAME


@pytest.mark.parametrize("kinds", [(1,), (2,), (3,), (4,), (2, 2), (2, 3, 4)])
def test_loads_of_all_types(tmp_path, kinds):
    write_plates(tmp_path / "plates.c3d", kinds)
    plates = read(tmp_path / "plates.c3d")
    assert len(plates) == len(kinds)
    for plate in plates:
        assert plate.rate == RATE * SAMPLES_PER_FRAME
        np.testing.assert_allclose(np.median(plate.vertical_force_n[LOADED]), LOAD_N, rtol=0.01)
        np.testing.assert_allclose(np.median(plate.vertical_force_n[:100]), 0, atol=1.0)


@pytest.mark.parametrize("kind", [1, 2, 3, 4])
def test_forces_are_those_of_ezc3d(tmp_path, kind):
    path = tmp_path / "plates.c3d"
    write_plates(path, (kind,))
    [plate] = read(path)
    expected = ezc3d.c3d(str(path), extract_forceplat_data=True)["data"]["platform"][0]["force"][2]
    np.testing.assert_allclose(np.abs(plate.vertical_force_n), np.abs(expected), atol=1e-3)


def test_corners_are_in_metres_with_y_up(tmp_path):
    write_plates(tmp_path / "plates.c3d", (2,))
    [plate] = read(tmp_path / "plates.c3d")
    np.testing.assert_allclose(plate.corners[:, 1], 0, atol=1e-6)
    np.testing.assert_allclose(np.sort(np.ptp(plate.corners, axis=0)), [0, 0.4, 0.6], atol=1e-6)


def test_the_baseline_of_unloaded_frames_is_removed(tmp_path):
    write_plates(tmp_path / "plates.c3d", (2,), zero=(1, 8), baseline_n=-60.0)
    [plate] = read(tmp_path / "plates.c3d")
    np.testing.assert_allclose(np.median(plate.vertical_force_n[:100]), 0, atol=1.0)
    np.testing.assert_allclose(np.median(plate.vertical_force_n[LOADED]), LOAD_N, rtol=0.01)


@pytest.mark.parametrize("missing", ["TYPE", "CORNERS", "CHANNEL"])
def test_plates_that_are_described_incompletely_are_none(tmp_path, missing):
    write_plates(tmp_path / "plates.c3d", (2,), removed=missing)
    assert read(tmp_path / "plates.c3d") == []


def test_a_calibrated_plate_without_its_matrix_is_none(tmp_path):
    write_plates(tmp_path / "plates.c3d", (4,), removed="CAL_MATRIX")
    assert read(tmp_path / "plates.c3d") == []


def test_a_damaged_head_gives_no_plates_and_no_error(tmp_path):
    path = tmp_path / "plates.c3d"
    write_plates(path, (2,))
    layout, data = get_layout(read_take(path, ReadOptions(up_axis="Z"))), bytearray(path.read_bytes())
    for start in range(512, layout.data_start_byte - 40, 97):
        damaged = bytes(data[:start] + bytes(40) + data[start + 40 :])
        assert isinstance(read_force_plates(damaged, layout, RATE), list)


@needs_captures
@pytest.mark.parametrize("name", ["JA1Gait35", "FunctionalWalk", "ADemo1_pc_integer", "walking2", "Qualisys"])
def test_forces_of_captures_are_those_of_ezc3d(name):
    path = C3D_CAPTURES / f"{name}.c3d"
    plates = read_force_plates(path.read_bytes(), get_layout(read_take(path)), RATE)
    expected = ezc3d.c3d(str(path), extract_forceplat_data=True)["data"]["platform"]
    assert len(plates) == len(expected) > 0
    for plate, other in zip(plates, expected, strict=True):
        np.testing.assert_allclose(np.abs(plate.vertical_force_n), np.abs(other["force"][2]), atol=0.01)


@needs_captures
def test_one_capture_in_three_encodings_has_one_force():
    forces = []
    for name in ("pc_int", "dec_real", "sgi_real"):
        path = C3D_CAPTURES / f"{name}.c3d"
        take = read_take(path)
        forces.append([plate.vertical_force_n for plate in read_force_plates(path.read_bytes(), get_layout(take), RATE)])
    for other in forces[1:]:
        np.testing.assert_allclose(other, forces[0], atol=1.0)
