"""The frame rate of a file and its missing frames: from its header, its times, its frame numbers and the option --rate.

Rates from 5 to 2,000 Hz are possible. Times are in seconds unless only milliseconds, or smaller units, give a possible rate; one
unit at most does. If header and times contradict each other, the times are used. Frames that the numbers or times leave out are
missing frames of the take.
"""

from collections.abc import Callable
from datetime import datetime
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from mocapfix.errors import ReadError
from mocapfix.io.file_content import parse_number
from mocapfix.options import ReadOptions

MIN_RATE_HZ, MAX_RATE_HZ = 5.0, 2000.0
COMMON_RATES_HZ = (
    *(24, 25, 30, 48, 50, 60, 72, 75, 80, 90, 96, 100, 120, 125, 144, 150, 160, 180, 200),
    *(240, 250, 256, 300, 360, 400, 480, 500, 512, 1000),
)
NTSC_RATES_HZ = tuple(base * 1000 / 1001 for base in (24, 30, 48, 60, 120, 240))
MAX_RATE_ROUNDING = 0.02  # relative difference of the common and the given rate; a frame time rounded by more is not replaced
LAST_DECIMAL_TOLERANCE = 1e-6  # of a unit of the last decimal, for the rounding error of the division
MIN_NOTED_RATE_CHANGE = 1e-5  # relative; a smaller change is a frame in half an hour at 60 Hz
MAX_COMMON_RATE_ERROR = 1e-3  # relative difference of a rate that is given as a frame time from the common one

TIME_UNITS_S = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
MAX_RATE_CONTRADICTION = 0.005  # relative; 59.94 and 60 Hz differ by 0.001, and programs write times of the nominal rate
MIN_GAP_EXCESS = 0.5  # of a frame: a time step that is longer by this, beyond the resolution of the times, omits frames
MAX_LATENESS_FRAMES = 1e9  # times that are later than this, in frames, are damaged: no take is so long
MAX_REGULAR_DEVIATION = 0.05  # of a frame: the median deviation of time steps, beyond their resolution, of a steady clock
COMPARED_TIMES = 5  # on either side of a long step, by whose mean lateness omitted frames are counted
JITTER_FACTOR = 2.5  # standard deviations of mean lateness that irregular times alone do not reach
MIN_ROUNDED_LONG_STEPS = 3  # long steps without which they omit frames rather than come from rounding
MAX_ROUNDING_RANGE = 0.999  # of rounding errors, in units of the last decimal; a frame as long as one has 1
ROUNDING_SLACK = 1.05  # by which the effects of rounding may exceed those of the last decimal
MAX_TIME_DECIMALS = 9
MAX_FRAME_NUMBER = 2**53  # larger whole numbers are not exact as floats
MAX_INSPECTED_TIMES = 1000  # from which their resolution is estimated

BuildError = Callable[[str], ReadError]


class FileFrames(NamedTuple):
    """The frames of a file."""

    rate: float  # frames per second
    first_frame: int  # the file's number of frame index 0
    row_frames: Int[np.ndarray, " R"]  # index of the frame of each of the R rows of the file; the frames between have no row
    notes: tuple[str, ...]  # sentences about assumptions

    @property
    def frame_count(self) -> int:
        """Number of frames, those without a row included."""
        return int(self.row_frames[-1]) + 1

    def spread_rows(self, rows: Shaped[np.ndarray, "*rows"], fill: float = np.nan) -> Shaped[np.ndarray, "*frames"]:
        """Return the rows of an array as frames, with `fill` in frames without a row."""
        if len(rows) == self.frame_count:
            return rows
        spread = np.full((self.frame_count, *rows.shape[1:]), fill, rows.dtype)
        spread[self.row_frames] = rows
        return spread


class FrameTimes(NamedTuple):
    """The time column of a table."""

    values: Float[np.ndarray, " R"]  # time of each row, NaN where it is missing
    unit_s: float | None  # seconds in its unit, None if the column does not name one


class _Clock(NamedTuple):
    """What times say: seconds in a frame, frames that each step omits, and the uncertainty of the rate."""

    frame_s: float  # seconds from one frame to the next
    omitted: Int[np.ndarray, " n"]  # frames omitted at each of the R - 1 steps, beyond those that frame numbers omit
    uncertainty: float  # relative uncertainty of `frame_s` by the last decimal of the times and their irregularity
    is_exact: bool  # whether the steps show no rounding: they are equal, or multiples of one
    irregularity_s: float  # median deviation of the steps if they are irregular, else 0
    unit_name: str  # the unit of the times if it is not the one expected, else ""


def choose_rate(
    build_error: BuildError, stated: float | None, options: ReadOptions, shown: str = ""
) -> tuple[float, tuple[str, ...]]:
    """Return the rate (Hz) of a file that states one or none and has no times, and a note if --rate contradicts it.

    Args:
        stated: The rate that the file states, None if it states none.
        options: --rate, which wins.
        shown: The text of the file, for the message, if it is no number.

    Raises:
        ReadError: If there is no possible rate. The message names --rate.
    """
    if options.rate_hz is not None:
        return options.rate_hz, _describe_contradiction(stated, options.rate_hz)
    if stated is None or not MIN_RATE_HZ <= stated <= MAX_RATE_HZ:
        problem = f"the frame rate is {shown!r}" if shown else "the file does not give its frame rate"
        if stated is not None:
            problem = f"a frame rate of {stated:g} Hz is not possible (5 to 2000)"
        raise build_error(f"{problem}; give it with --rate HZ.")
    return stated, ()


def find_frames(
    build_row_error: Callable[[int, str], ReadError],
    build_rate_error: BuildError,
    row_count: int,
    *,
    stated_rate: str,
    times: FrameTimes | None,
    frame_numbers: Float[np.ndarray, " R"] | None,
    options: ReadOptions,
) -> FileFrames:
    """Find the rate of a table and the frame of each of its rows.

    Args:
        build_row_error: Builds an error from the index of a row and a sentence.
        stated_rate: The rate as the header gives it, "" if it does not.
        times: The time column, None if there is none.
        frame_numbers: The column of frame numbers, None if there is none.
        options: --rate.

    Raises:
        ReadError: If there is no possible rate, frame numbers or times are not in order, or more frames are missing than present.
    """
    steps, first_frame, notes = np.ones(max(0, row_count - 1), int), 1, list[str]()
    if frame_numbers is not None:
        steps, first_frame, numbering_notes = _count_number_steps(build_row_error, frame_numbers)
        notes += numbering_notes
    try:
        stated = parse_number(stated_rate.strip())
    except ValueError:
        stated = np.nan
    stated = stated if 0 < stated < np.inf else None
    clock = None
    if times is not None and row_count > 1:
        clock = _read_clock(times, steps, stated)
        decreasing = np.flatnonzero(np.diff(times.values) < 0)
        if frame_numbers is None and len(decreasing):
            raise _build_step_error(build_row_error, times, int(decreasing[0]))
        if clock is not None:
            steps = steps + clock.omitted
            if frame_numbers is not None and clock.omitted.any():
                number = frame_numbers[int(np.argmax(clock.omitted > 0))]
                notes.append(
                    f"Times omit frames after number {number:.0f}, where numbers go on; frames are counted by the times."
                )
    if steps.sum() + 1 > 2 * row_count:
        row = int(np.argmax(steps))
        if frame_numbers is None and times is not None:
            raise _build_step_error(build_row_error, times, row)
        numbers = frame_numbers if frame_numbers is not None else np.arange(row_count)
        raise _build_number_error(build_row_error, numbers, row)
    row_frames = np.concatenate([[0], np.cumsum(steps)]).astype(int)
    rate, rate_notes = _combine_rates(build_rate_error, stated, stated_rate, clock, options)
    notes += [*rate_notes, *describe_missing_frames(first_frame, row_frames)]
    return FileFrames(rate, first_frame, row_frames, tuple(notes))


def describe_missing_frames(first_frame: int, row_frames: Int[np.ndarray, " R"]) -> tuple[str, ...]:
    """Return a note on the frames that have no row in the file, if there are any."""
    missing = np.setdiff1d(np.arange(row_frames[-1] + 1), row_frames)
    if not len(missing):
        return ()
    last = missing[0] + int(np.argmax(np.append(np.diff(missing) != 1, True)))
    first_run = f"{first_frame + missing[0]}" + (f" to {first_frame + last}" if last > missing[0] else "")
    subject = f"Frame {first_run} is" if len(missing) == 1 else f"{len(missing)} frames, first {first_run}, are"
    return (f"{subject} missing from the file; the motion is filled there, and the copy of the file keeps its rows.",)


def parse_time(text: str) -> float:
    """Return the time that a cell spells: a number, or a date and time of ISO 8601, or a clock time, in seconds; NaN if none."""
    try:
        return parse_number(text)
    except ValueError:
        pass
    try:
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError):
        pass
    try:
        hours, minutes, seconds = text.split(":")
        return 3600 * int(hours) + 60 * int(minutes) + parse_number(seconds)
    except ValueError:
        return np.nan


def read_frame_time(text: str) -> tuple[float, tuple[str, ...]] | None:
    """Return the rate (Hz) of a frame time as a BVH spells it, and a note on what was assumed; None if no rate is possible.

    The time is in seconds. Milliseconds, microseconds or a rate instead of a time are recognised by a common rate.
    """
    value = float(text)
    if not (np.isfinite(value) and value > 0):
        return None
    rate, notes = infer_rate(text)
    if MIN_RATE_HZ <= rate <= MAX_RATE_HZ:
        return rate, notes
    if rate > MAX_RATE_HZ or value == 1:  # 1 is a place holder rather than 1000 Hz
        return None
    common = [each for each in (*COMMON_RATES_HZ, *NTSC_RATES_HZ) if abs(value / each - 1) < MAX_COMMON_RATE_ERROR]
    if common:
        nearest = min(common, key=lambda each: abs(value / each - 1))
        return float(nearest), (f"The frame time {text} is no time; it is taken as a rate of {nearest:g} Hz.",)
    for name in ("milliseconds", "microseconds"):
        rate, _ = infer_rate(text, TIME_UNITS_S[name])
        is_common = any(rate == each for each in (*COMMON_RATES_HZ, *NTSC_RATES_HZ))
        if MIN_RATE_HZ <= rate <= MAX_RATE_HZ and (is_common or value != round(value)):
            return rate, (f"The frame time {text} is taken as {name}: {rate:g} Hz.",)
    return None


def infer_rate(frame_time_text: str, unit_s: float = 1.0) -> tuple[float, tuple[str, ...]]:
    """Return the rate (Hz) of a frame time as the file spells it, and a note if it was rounded.

    A frame time of .0083 is that of any rate from 119.8 to 121.2 Hz. It is taken as 120 Hz, the common rate whose frame time
    rounds, or is cut off, to these decimals.
    """
    seconds = float(frame_time_text) * unit_s
    rate = 1 / seconds
    mantissa, _, exponent = frame_time_text.lower().partition("e")
    last_decimal_s = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2])) * unit_s
    # The error is -0.5 to 0.5 units of the last decimal if the time was rounded, 0 to 1 if it was cut off.
    for rates, lowest in ((COMMON_RATES_HZ, -0.5), (NTSC_RATES_HZ, -0.5), (COMMON_RATES_HZ, 0.0), (NTSC_RATES_HZ, 0.0)):
        nearest = min(rates, key=lambda each: abs(each - rate))
        error = (1 / nearest - seconds) / last_decimal_s
        is_in_range = lowest - LAST_DECIMAL_TOLERANCE <= error <= lowest + 1 + LAST_DECIMAL_TOLERANCE
        if is_in_range and abs(nearest / rate - 1) < MAX_RATE_ROUNDING:
            is_noted = abs(nearest / rate - 1) > MIN_NOTED_RATE_CHANGE
            note = f"The frame time {frame_time_text} s is rounded; {nearest:g} Hz is assumed."
            return float(nearest), (note,) if is_noted else ()
    return rate, ()


def count_frame_steps(numbers: Float[np.ndarray, " R"]) -> tuple[Int[np.ndarray, " n"], int, int | None]:
    """Return the frames from each row to the next, how much numbers increase in a frame, and the first row out of order.

    Numbers may increase by a constant; a multiple of it omits frames.
    """
    differences = np.diff(numbers)
    positive = differences[differences > 0]
    values, counts = np.unique(positive, return_counts=True)
    step = float(values[np.argmax(counts)]) if len(values) else 1.0
    if 2 * counts.max(initial=0) <= len(differences):
        step = 1.0
    is_irregular = (differences <= 0) | (differences % step != 0)
    irregular = int(np.argmax(is_irregular)) if is_irregular.any() else None
    return (differences / step).astype(int), int(step), irregular


def _count_number_steps(
    build_row_error: Callable[[int, str], ReadError], frame_numbers: Float[np.ndarray, " R"]
) -> tuple[Int[np.ndarray, " n"], int, tuple[str, ...]]:
    """Return the frames from each row to the next, the number of the first, and a note if numbers increase by more than one."""
    is_invalid = ~(np.abs(frame_numbers) < MAX_FRAME_NUMBER) | (frame_numbers != np.rint(frame_numbers))
    if is_invalid.any():
        raise build_row_error(int(np.argmax(is_invalid)), "does not begin with a frame number; export it again.")
    steps, increment, irregular = count_frame_steps(frame_numbers)
    if irregular is not None:
        raise _build_number_error(build_row_error, frame_numbers, irregular)
    first = int(frame_numbers[0])
    if increment == 1:
        return steps, first, ()
    note = f"Frame numbers in the file increase by {increment}; they are counted here from {first} in steps of one."
    return steps, first, (note,)


def _build_number_error(
    build_row_error: Callable[[int, str], ReadError], frame_numbers: Float[np.ndarray, " R"], row: int
) -> ReadError:
    problem = f"frame {frame_numbers[row + 1]:.0f} follows frame {frame_numbers[row]:.0f}"
    return build_row_error(row + 1, f"{problem}; export the complete trial.")


def _build_step_error(build_row_error: Callable[[int, str], ReadError], times: FrameTimes, row: int) -> ReadError:
    steps = np.diff(times.values)
    problem = f"the time step is {steps[row]:g}, elsewhere {np.nanmedian(steps):g}"
    return build_row_error(row + 1, f"{problem}; export the complete trial, or with its frame numbers.")


def _read_clock(times: FrameTimes, steps: Int[np.ndarray, " n"], stated: float | None) -> _Clock | None:
    """Read what a time column says; None if it says nothing: no numbers, decreasing or constant times, or a count of frames."""
    is_known = np.isfinite(times.values)
    rows = np.flatnonzero(is_known)
    if 2 * len(rows) <= len(is_known):
        return None
    values = np.interp(np.arange(len(is_known)), rows, times.values[rows])
    differences = np.diff(values)
    if (differences < 0).any() or not values[-1] > values[0]:
        return None
    usual, resolution = float(np.median(differences / steps)), _estimate_resolution(values)
    if stated and _agrees_with_rate(values, steps, resolution, times.unit_s or 1.0, stated):
        return None
    is_rounded = usual == 0 or (differences / steps).min() < usual - resolution / 4  # omitted frames make no step shorter
    noise = resolution if is_rounded else 0.0
    is_usual = (differences / steps <= (1 + MIN_GAP_EXCESS) * usual + noise) | (usual == 0)
    frame = float(differences[is_usual].sum() / steps[is_usual].sum())
    omitted = _count_omitted_frames(differences / frame - steps, noise / frame) if frame > 0 else np.zeros(len(steps), int)
    if (omitted > 0).sum() >= MIN_ROUNDED_LONG_STEPS and _is_rounded_clock(values, steps, resolution):
        omitted, noise = np.zeros(len(steps), int), resolution
    total = steps + omitted
    frame = float((values[-1] - values[0]) / total.sum())
    if times.unit_s in (None, 1.0) and usual == 1 and (values == np.rint(values)).all():
        return None  # a count of frames
    unit = _choose_time_unit(frame, times.unit_s, stated)
    if unit is None:
        return None
    deviation = float(np.median(np.abs(differences / total - frame)))
    is_irregular = deviation > MAX_REGULAR_DEVIATION * frame + resolution / 2
    unit_s = TIME_UNITS_S[unit]
    uncertainty = (resolution + 2 * deviation * is_irregular) / (values[-1] - values[0])
    jitter_s, unit_name = deviation * unit_s if is_irregular else 0.0, "" if unit_s == (times.unit_s or 1.0) else unit
    return _Clock(frame * unit_s, omitted, uncertainty, noise == 0, jitter_s, unit_name)


def _count_omitted_frames(excess: Float[np.ndarray, " n"], noise: float) -> Int[np.ndarray, " n"]:
    """Return the frames that each time step omits, by its excess and the noise of rounding, in frames.

    A long step omits frames if the times after it are late, on average, compared with those before it. A single time that is
    late omits none.
    """
    lateness, omitted = np.concatenate([[0.0], np.cumsum(excess)]), np.zeros(len(excess), int)
    if not np.all(np.abs(lateness) < MAX_LATENESS_FRAMES):
        return omitted
    long_steps = np.flatnonzero(excess > MIN_GAP_EXCESS + noise).tolist()
    jitter = float(np.median(np.abs(excess)))  # about the standard deviation of a time: a step has two
    for step, previous, following in zip(long_steps, [-1, *long_steps], [*long_steps[1:], len(excess)], strict=False):
        before = lateness[max(previous + 1, step + 1 - COMPARED_TIMES) : step + 1]
        after = lateness[step + 1 : min(following, step + COMPARED_TIMES) + 1]
        late = float(after.mean() - before.mean())
        if late > MIN_GAP_EXCESS + JITTER_FACTOR * jitter * np.sqrt(1 / len(before) + 1 / len(after)):
            omitted[step] = round(late)
    return omitted


def _agrees_with_rate(
    values: Float[np.ndarray, " R"], steps: Int[np.ndarray, " n"], resolution: float, unit_s: float, rate: float
) -> bool:
    """Return whether times are those of a clock of this rate without omitted frames, rounded to their last decimal."""
    lateness_s = values * unit_s - np.concatenate([[0], np.cumsum(steps)]) / rate
    return bool(np.ptp(lateness_s) < MAX_ROUNDING_RANGE * resolution * unit_s)


def _is_rounded_clock(values: Float[np.ndarray, " R"], steps: Int[np.ndarray, " n"], resolution: float) -> bool:
    """Return whether times are those of a steady clock without omitted frames, rounded to their last decimal."""
    frames = np.concatenate([[0], np.cumsum(steps)])
    residual = values - np.polyval(np.polyfit(frames, values - values[0], 1), frames)
    return bool(np.ptp(residual) <= ROUNDING_SLACK * resolution)


def _estimate_resolution(values: Float[np.ndarray, " R"]) -> float:
    """Return the unit of the last decimal of times, 0 if it is below a thousand-millionth."""
    differences = (values - values[0])[:MAX_INSPECTED_TIMES]
    for decimals in range(MAX_TIME_DECIMALS + 1):
        scaled = differences * 10.0**decimals
        tolerance = 1e-4 + 4 * np.finfo(float).eps * np.abs(values).max() * 10.0**decimals
        if (np.abs(scaled - np.rint(scaled)) <= tolerance).all():
            return 10.0**-decimals
    return 0.0


def _choose_time_unit(frame: float, unit_s: float | None, stated: float | None) -> str | None:
    """Return the name of the unit in which a time step is that of a possible rate; None if there is none."""
    possible = [name for name, unit in TIME_UNITS_S.items() if MIN_RATE_HZ <= 1 / (frame * unit) <= MAX_RATE_HZ]
    named = [name for name in possible if TIME_UNITS_S[name] == unit_s]
    agreeing = [name for name in possible if stated and abs(frame * TIME_UNITS_S[name] * stated - 1) < MAX_RATE_ROUNDING]
    return next(iter((*named, *agreeing, *possible)), None)


def _combine_rates(
    build_error: BuildError, stated: float | None, stated_text: str, clock: _Clock | None, options: ReadOptions
) -> tuple[float, list[str]]:
    """Return the rate that header, times and --rate give together, and notes on contradictions and assumptions."""
    if clock is None or not MIN_RATE_HZ <= 1 / clock.frame_s <= MAX_RATE_HZ:
        rate, rate_notes = choose_rate(build_error, stated, options, stated_text)
        return rate, list(rate_notes)
    measured, notes = _round_rate(1 / clock.frame_s, 0.0 if clock.is_exact else clock.uncertainty), list[str]()
    if options.rate_hz is not None:
        return options.rate_hz, list(_describe_contradiction(measured, options.rate_hz))
    if stated is not None and abs(1 / (stated * clock.frame_s) - 1) <= max(
        MAX_RATE_CONTRADICTION, ROUNDING_SLACK * clock.uncertainty
    ):
        return stated, []
    if stated is not None:
        notes.append(f"The header says {stated:g} Hz and the time column {measured:g} Hz; the time column is used.")
    if clock.unit_name:
        notes.append(f"Times are taken as {clock.unit_name}: {measured:g} Hz.")
    if clock.irregularity_s:
        spread = f"{clock.irregularity_s * 1e3:.2g} ms"
        notes.append(f"The time steps are irregular, by {spread} or more in half of them; their rate of {measured:g} Hz is used.")
    return measured, notes


def _describe_contradiction(stated: float | None, rate: float) -> tuple[str, ...]:
    if stated is None or not np.isfinite(stated) or abs(stated / rate - 1) <= MAX_RATE_CONTRADICTION:
        return ()
    return (f"The file says {stated:g} Hz; the {rate:g} Hz of --rate are used.",)


def _round_rate(rate: float, uncertainty: float) -> float:
    """Return the common rate within the uncertainty (relative) of a rate, otherwise the rate with three decimals."""
    candidates = [round(rate), *COMMON_RATES_HZ, *NTSC_RATES_HZ]
    near = [each for each in candidates if abs(each / rate - 1) <= uncertainty]
    return float(min(near, key=lambda each: abs(each - rate))) if near else round(rate, 3)
