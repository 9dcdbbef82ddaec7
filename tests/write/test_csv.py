import csv

import numpy as np

from mocapfix import write
from mocapfix.read import capture
from mocapfix.take import Take
from tests.text_files import STANDING

Y_UP = STANDING[..., [1, 2, 0]] / 1000


def test_one_line_of_names_and_then_numbers(tmp_path):
    take = Take(Y_UP.copy(), ("LFHD", "Jim:LANK", "hand, left"), 50, 7)
    take.markers[1, 1] = np.nan
    write.write_csv(tmp_path / "walk.csv", take)
    with (tmp_path / "walk.csv").open(newline="") as file:
        names, *rows = csv.reader(file)
    assert names[:5] == ["frame", "time_s", "LFHD_X_mm", "LFHD_Y_mm", "LFHD_Z_mm"]
    assert names[-1] == "hand, left_Z_mm"
    assert rows[1] == ["8", "0.020000", "11.00000", "21.00000", "1701.00000", "", "", "", "401.00000", "21.50000", "1001.00000"]
    assert len(rows) == 4
    assert capture.read_capture(tmp_path / "walk.csv").labels == take.labels


def test_a_label_that_holds_a_line_end_stays_in_the_line_of_names(tmp_path):
    path = tmp_path / "walk.csv"
    write.write_csv(path, Take(np.arange(18.0).reshape(3, 2, 3), ("left\nheel", "LTOE"), 100.0))
    assert capture.read_capture(path).labels == ("left heel", "LTOE")
