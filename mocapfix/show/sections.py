"""The sections of the report page, each as HTML, or "" where there is nothing to say; all text from outside is escaped."""

from html import escape

import numpy as np

from mocapfix.show import figures, summary, timeline
from mocapfix.show.cleaning import Cleaning
from mocapfix.show.kinds import GROUPS, group
from mocapfix.show.markup import bars, legend, table
from mocapfix.show.states import DOUBTED, EMPTY, RELABELLED, former, mended
from mocapfix.show.summary import number
from mocapfix.take import Take
from mocapfix.words import worded

NAMED = 12  # markers named below a picture

# Classes of the page's style sheet, and what they mean.
CURVES = (("middle", "median of the markers"), ("high", "95th percentile"))
RESIDUALS = (("middle", "mean"), ("high", "95th percentile, mm"))
DEVIATIONS = (("middle", "predicted error per axis, mean"), ("high", "95th percentile, mm"))


def overview(record: dict, cleaning: Cleaning) -> str:
    """What was wrong, what was done, what was left, in figures and in sentences."""
    fill, solve = record["fill"], record["solve"]
    values = [
        (f"{fill['missing_before'] / max(1, cleaning.before.seen.size):.1%}", "of the samples missing before"),
        (f"{fill['filled']:,}", "samples filled"),
        (f"{fill['mended']:,}", "faulty samples replaced"),
        (f"{fill['left_empty']:,}", "samples left empty"),
    ]
    if fill["relabelled"]:
        values.insert(1, (f"{fill['relabelled']:,}", "samples put under their own labels"))
    if solve is not None:
        values.append((f"{number(solve['marker_residual_mm']['mean'])} mm", "from markers to body, mean"))
    facts = "".join(f"<div><b>{value}</b><small>{worded(what, cleaning.before)}</small></div>" for value, what in values)
    answers = [("What was wrong", summary.wrong(record, cleaning)), ("What was done", summary.done(record, cleaning))]
    answers += [("What was left", summary.left(record, cleaning)), *(("To know", note) for note in record["notes"])]
    sentences = "".join(f"<dt>{question}</dt><dd>{escape(answer)}</dd>" for question, answer in answers)
    return f'<div class="facts">{facts}</div><dl class="summary">{sentences}</dl>'


def worst_moment(cleaning: Cleaning) -> str:
    """The frame in which most was mended, before and after."""
    before, after = cleaning.before, cleaning.after
    t = figures.worst_frame(cleaning.state, cleaning.joints)
    pictures = figures.stick_figures(cleaning, t)
    state, was = cleaning.state[t], former(before.seen[t], cleaning.state[t])
    words = [
        _named("missing", was == EMPTY, before)
        + _named("judged faulty (red)", was == DOUBTED, before)
        + _named("under another label (violet)", was == RELABELLED, before)
        or worded("all markers are there", before),
        _named("mended (green)", mended(state), after)
        + _named("under their own labels (violet)", state == RELABELLED, after)
        + _named("left empty", state == EMPTY, after)
        or "nothing to mend",
    ]
    parts = "".join(
        f"<figure>{picture}<figcaption><b>{name}</b> {escape(text)}</figcaption></figure>"
        for name, picture, text in zip(("Before:", "After:"), pictures, words, strict=True)
    )
    frame = f"Frame {before.frame_number(t)}, {t / before.rate:.2f} s from the first"
    return f'<h2>The worst moment</h2><p class="soft">{frame}.</p><div class="figures">{parts}</div>'


def _named(what: str, mask: np.ndarray, take: Take) -> str:
    labels = [take.labels[m] for m in np.flatnonzero(mask)]
    more = f" and {len(labels) - NAMED} more" if len(labels) > NAMED else ""
    return f"{len(labels)} {what}: {', '.join(labels[:NAMED])}{more}. " if labels else ""


def time_line(cleaning: Cleaning) -> str:
    """When which marker failed, and how far the markers were from the body meanwhile."""
    rows, error, text = timeline.rows(cleaning), cleaning.error, ""
    if rows:
        there = {group(fault.kind) for fault in cleaning.faults.items}
        groups = [each for each in GROUPS if each[0] in there or " " in each[0]]
        text += f"<h2>Faults over time</h2>{legend((name, worded(said, cleaning.before)) for name, said in groups)}{rows}"
    if error is not None and (curves := timeline.curves(error)):
        axis = timeline.axis(cleaning.before)
        text += f"<h2>Distance of the markers from the body</h2>{legend(CURVES)}{curves}{axis}"
    return text


def residuals(record: dict) -> str:
    """How far each marker was seen from the body, how surely the joints are known, and how the solve of each frame ended."""
    if (solve := record["solve"]) is None:
        return ""
    markers, joints = _spreads(solve["marker_residual_mm"]["by_marker"]), _spreads(solve["joint_deviation_mm"])
    status = table(("Frames", "How their solve ended"), [(f"{n:,}", text) for text, n in solve["status"].items() if n])
    steps = f"{number(solve['iterations_mean'])} iterations a frame on average, from the start {escape(solve['start'])}."
    iterations = f'<p class="soft">{steps} {_prior(solve)}</p>'
    return (
        f"<h2>Each marker’s distance from the body</h2>{legend(RESIDUALS)}{markers}"
        f"<h2>How surely each joint is known</h2>{legend(DEVIATIONS)}{joints}<h2>The solve</h2>{status}{iterations}"
    )


def _prior(solve: dict) -> str:
    """What limbs that were lost were put back from."""
    if (prior := solve["prior"]) is None:
        return "Lost limbs come from the take’s own motion."
    less = "" if prior["scale"] == 1 else f", its standard deviations times {prior['scale']:g}"
    return f"Lost limbs come from the take’s own motion and from people’s poses (the prior {escape(prior['name'])}{less})."


def _spreads(spread: dict[str, dict]) -> str:
    """Bars of what has a mean and a 95th percentile, the largest first."""
    known = {name: value for name, value in spread.items() if value["mean"] is not None and np.isfinite(value["mean"])}
    top = max([value["p95"] for value in known.values()] + [1e-9])
    rows = []
    for name, value in sorted(known.items(), key=lambda item: -item[1]["mean"]):
        mean, high = value["mean"], value["p95"]
        rows.append((name, (("high", high / top), ("middle", mean / top)), f"{number(mean)} / {number(high)}"))
    return bars(rows)


def subject(record: dict) -> str:
    """The person's bones."""
    if (person := record["subject"]) is None:
        return ""
    top = max([*person["bones_m"].values(), 1e-9])
    rows = [(name, (("high", m / top),), f"{number(100 * m)} cm") for name, m in person["bones_m"].items() if m > 0]
    source = f"calibrated on {person['frames']:,} frames" if person["frames"] else "of a nominal body"
    words = f"Bone lengths, {source}; marker set {escape(person['marker_set'])}."
    return f'<h2>The person</h2><p class="soft">{words}</p>{bars(rows)}'


def seconds(record: dict) -> str:
    """Where the time went."""
    rows = [(stage, f"{s:.2f} s") for stage, s in record["seconds"].items()]
    return f"<h2>Time spent</h2>{table(('Stage', 'Seconds'), rows)}"
