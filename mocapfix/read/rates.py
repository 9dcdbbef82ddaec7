"""Frame times as files round them, and the rates they were rounded from."""

USUAL = (24, 25, 30, 48, 50, 60, 72, 75, 80, 90, 96, 100, 120, 125, 144, 150, 160, 180, 200, 240, 250, 256, 300, 360, 400, 480)
USUAL += (500, 512, 1000)
NTSC = tuple(base * 1000 / 1001 for base in (24, 30, 48, 60, 120, 240))  # television's rates
ROUNDING = 0.02  # of a rate: a frame time that says less than this says nothing
SLACK = 1e-6  # of a last decimal: for the rounding of the division
SMALL = 1e-5  # of a rate: too little to speak of, a frame in half an hour at 60 Hz


def usual(spelled: str) -> tuple[float, str]:
    """-> the rate in Hz of a frame time as it is spelled in seconds, and a note, "" where nothing was assumed.

    .0083 may be any rate from 119.8 to 121.2 Hz: it is taken as 120, the usual one that it may have been rounded from, or
    cut off from, to so many decimals.
    """
    seconds = float(spelled)
    rate = 1 / seconds
    mantissa, _, exponent = spelled.lower().partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    for rates, lowest in ((USUAL, -0.5), (NTSC, -0.5), (USUAL, 0.0), (NTSC, 0.0)):  # rounded; cut off
        nearest = min(rates, key=lambda each: abs(each - rate))
        lost = (1 / nearest - seconds) / unit
        if lowest - SLACK <= lost <= lowest + 1 + SLACK and abs(nearest / rate - 1) < ROUNDING:
            far = abs(nearest / rate - 1) > SMALL
            return float(nearest), f"Its frame time {spelled} s was taken as {nearest:g} Hz, rounded." if far else ""
    return rate, ""
