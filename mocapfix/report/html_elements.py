"""The page's few forms: a table, rows of bars, a legend; everything they are given is escaped."""

from collections.abc import Iterable, Sequence
from html import escape

MAX_LIST_ROWS = 1000  # rows that a list shows at most; the JSON report has them all
MAX_OPEN_LIST_ROWS = 40  # rows that are shown without unfolding the list


def render_legend(kinds: Iterable[tuple[str, str]]) -> str:
    """What colours mean: classes of the page's style sheet, each with its meaning."""
    return '<p class="legend">' + "".join(f'<span><i class="{name}"></i>{escape(text)}</span>' for name, text in kinds) + "</p>"


def format_frame_range(first: int, last: int) -> str:
    """The file's own numbers, inclusive at both ends."""
    return f"{first}–{last}" if last > first else f"{first}"


def render_truncation_note(count: int) -> str:
    """What stands below a list of `count` rows that was cut."""
    return f"<p>And {count - MAX_LIST_ROWS:,} more, all in the JSON report.</p>" if count > MAX_LIST_ROWS else ""


def render_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table that scrolls sideways where the screen is narrow."""
    top = "".join(f"<th>{escape(name)}</th>" for name in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{top}</tr>{body}</table></div>'


def render_bars(rows: Iterable[tuple[str, Iterable[tuple[str, float]], str]]) -> str:
    """Rows of a name, bars (class and share of the width, the longest first) and a value."""
    lines = (
        f"<div><b>{escape(name)}</b><span>"
        + "".join(f'<i class="{kind}" style="width:{share:.1%}"></i>' for kind, share in parts)
        + f"</span><em>{escape(value)}</em></div>"
        for name, parts, value in rows
    )
    return f'<div class="bars">{"".join(lines)}</div>'


def render_collapsible_list(name: str, count: int, content: str) -> str:
    """A list of `count` things called so, shown at once unless it is long."""
    plural = f"{name}es" if name.endswith("ch") else f"{name}s"
    start = "" if count > MAX_OPEN_LIST_ROWS else " open"
    return f"<details{start}><summary>{count:,} {plural if count > 1 else name}</summary>{content}</details>"
