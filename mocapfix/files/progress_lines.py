"""Lines by which a command reports its stages to a program that has started it."""

STAGE_LINES_VARIABLE = "MOCAPFIX_STAGE_LINES"
"""environment variable: if it is set, commands write a line at the beginning of each stage to standard error"""
STAGE_LINE_PREFIX = "stage: "


def parse_stage_line(line: str) -> str | None:
    """Return the stage that a line reports, None for any other line."""
    return line.removeprefix(STAGE_LINE_PREFIX).strip() if line.startswith(STAGE_LINE_PREFIX) else None
