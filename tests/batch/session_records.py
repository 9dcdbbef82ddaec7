"""Records of takes that were never cleaned, for the session page and its tables."""

from hypothesis import strategies as st

from mocapfix.batch.records import SubjectFigures, TakeRecord

PICTURE = '<svg class="moment" viewBox="0 0 90 190" role="img"><title>Frame 7.</title><path class="dot ok" d="M9 9h0"/></svg>'


def build_figures(subject: str = "", **fields) -> SubjectFigures:
    known = {"marker_set": "cmu41", "frame_count": 1200, "rate_hz": 120.0, "duration_s": 10.0, "sample_count": 49200}
    known |= {"missing_before": 2467, "filled": 2400, "left_empty": 67, "fault_counts": {"gap": 49, "spike": 2}}
    known |= {"worst_predicted_error_mm": 92.3, "worst_frame": 156, "residual_mm": 4.523, "picture_svg": PICTURE}
    return SubjectFigures.model_validate({"subject": subject, **known, **fields})


def build_done(take: str, *subjects: str, **fields) -> TakeRecord:
    stem = take.rpartition(".")[0]
    name = stem.rpartition("/")[2]
    suffixes = ["c3d"] + [f"{s}.{each}" if s else each for s in subjects or ("",) for each in ("bvh", "report.html")]
    outputs = {suffix: f"{stem}/{name}.{suffix}" for suffix in suffixes}
    figures = tuple(build_figures(each) for each in subjects or ("",))
    known = {"take": take, "input": f"/in/{take}", "status": "done", "seconds": 4.5, "outputs": outputs, "subjects": figures}
    return TakeRecord.model_validate({**known, **fields})


def build_failed(take: str, error: str = "it is empty.", reason: str = "error") -> TakeRecord:
    return TakeRecord.model_validate({"take": take, "input": f"/in/{take}", "status": "failed", "reason": reason, "error": error})


names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=300)


@st.composite
def take_records(draw: st.DrawFn) -> TakeRecord:
    """Draw a record with any texts."""
    take = draw(names)
    if draw(st.booleans()):
        return build_failed(take, draw(names), draw(st.sampled_from(["error", "timeout", "memory", "crash"])))
    counts = st.integers(0, 10**9)
    figures = build_figures(
        draw(names),
        marker_set=draw(st.none() | names),
        filled=draw(counts),
        fault_counts={"gap": draw(counts), "leading gap": draw(counts)},
        worst_predicted_error_mm=draw(st.none() | st.floats(0, 1e12)),
        residual_mm=draw(st.none() | st.floats(0, 1e12)),
        notes=(draw(names),),
    )
    return build_done("walk.c3d").model_copy(update={"take": take, "subjects": (figures,), "outputs": {"c3d": draw(names)}})
