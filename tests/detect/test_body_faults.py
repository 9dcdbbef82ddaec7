from mocapfix.detect import loop
from tests.detect.bodies import exchanged
from tests.detect.on_body import displaced, solved


def found(take):
    return loop.detect_body_faults(take, take.seen, solved().subject, solved().motion)


def test_a_sound_take_has_no_faults():
    assert found(solved().take) == []


def test_each_kind_is_told_from_the_others():
    take = exchanged(solved().take, (3, 17), 60, 110)
    take = displaced(displaced(take, 8, 150, 152, (0, 0.1, 0)), 20, 200, 260, (0.1, 0, 0))
    told = sorted((fault.first, fault.last, fault.kind) for fault in found(take))
    assert told == [(60, 110, "swap"), (150, 152, "spike"), (200, 260, "ghost")]


def test_what_meets_an_exchange_waits_until_that_is_undone():
    take = exchanged(displaced(solved().take, 8, 70, 80, (0, 0.1, 0)), (3, 17), 60, 110)
    (swap,) = found(take)
    assert swap.kind == "swap"
    (ghost,) = found(take.exchange_labels(swap.markers, swap.first, swap.last))
    assert (ghost.kind, ghost.marker, ghost.first, ghost.last) == ("ghost", 8, 70, 80)


def test_what_was_found_is_not_found_again():
    take = displaced(solved().take, 20, 200, 260, (0.1, 0, 0))
    (ghost,) = found(take)
    rest = take.visible.copy()
    rest[ghost.frame_slice, ghost.marker] = False
    assert found(take.masked(rest)) == []
