from pathlib import Path

import numpy as np
import pytest

from mocapfix.io import capture
from tests.text_files import LABELS, STANDING, assert_refused, nexus, workstation

Y_UP = STANDING[..., [1, 2, 0]] / 1000
OUTPUTS = "Model Outputs\n120\n,,Jim:LKneeAngles,,\nFrame,Sub Frame,X,Y,Z\n,,deg,deg,deg\n695,0,1,2,3\n696,0,1,2,3\n\n"
DEVICES = "\nDevices\n1200\n,,Force\nFrame,Sub Frame,Fx\n,,N\n695,0,0.1\n695,1,0.1\n"


def write_and_read(folder: Path, text: str):
    path = folder / "walk.csv"
    path.write_bytes(text.encode())
    return capture.read_take(path)


@pytest.mark.parametrize("before", ["", OUTPUTS])
@pytest.mark.parametrize("after", ["", DEVICES])
@pytest.mark.parametrize("rate", ["120", "120,Hz", "120,,,,,", "120.0"])
def test_the_section_of_trajectories_is_found(tmp_path, before, after, rate):
    take = write_and_read(tmp_path, nexus(before=before, after=after, rate=rate))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-9)
    assert (take.labels, take.rate, take.first_frame, take.frame_count, take.other_labels) == (LABELS, 120, 695, 4, ())


def test_section_names_as_a_spreadsheet_saves_them(tmp_path):
    text = nexus().replace("Trajectories\n", "Trajectories,,,,,,,,,,\n").replace("\n", ",,\r\n")
    np.testing.assert_allclose(write_and_read(tmp_path, text).markers, Y_UP, atol=1e-9)
    np.testing.assert_allclose(write_and_read(tmp_path, nexus().replace(",", ";").replace(".", ",")).markers, Y_UP, atol=1e-9)


def test_velocities_are_ignored(tmp_path):
    np.testing.assert_allclose(write_and_read(tmp_path, nexus(velocities=True)).markers, Y_UP, atol=1e-9)


def test_units_and_blanks(tmp_path):
    xyz = STANDING / 1000
    xyz[1, 0] = np.nan
    take = write_and_read(tmp_path, nexus(xyz, units="m"))
    np.testing.assert_allclose(take.markers, xyz[..., [1, 2, 0]], atol=0.6e-3)
    assert not take.visible[1, 0]


def test_workstations_export(tmp_path):
    labels = [*LABELS, "Jim:LHipAngles", "*12"]
    take = write_and_read(tmp_path, workstation(np.concatenate([STANDING, STANDING[:, :2]], 1), labels))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-9)
    assert (take.labels, take.rate, take.first_frame) == (LABELS, 100, 1)
    assert take.other_labels == ("Jim:LHipAngles", "*12")


INVALID_FILES = {
    "model outputs alone": (OUTPUTS, "has model outputs and no trajectories; export the trajectories as well"),
    "no names": (nexus(labels=("", "", "")), "line 3: names no markers"),
    "no axes": ("Trajectories\n120\n", "line 1: no line that begins with Frame and names the axes follows"),
    "no frames": ("\n".join(nexus().split("\n")[:5]), "line 4: no frames follow"),
    "a unit": (nexus(units="ells"), "line 5: the unit is 'ells'"),
    "a word": (nexus().replace("1701.000", "oops"), "line 7: field 5 is 'oops'"),
    "cut off": (nexus()[:-20], "line 9: the file is cut off"),
    "rate": (nexus(rate="0"), "line 2: the frame rate is '0'"),
}


@pytest.mark.parametrize("case", INVALID_FILES)
def test_invalid_files_are_refused_with_the_line(tmp_path, case):
    assert_refused(write_and_read, tmp_path, *INVALID_FILES[case])
