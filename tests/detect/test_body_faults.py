from mocapfix.detect.loop import detect_body_faults
from tests.detect.bodies import exchanged
from tests.detect.on_body import displaced, solved


def detect(take):
    return detect_body_faults(take, take.visible, solved().subject, solved().motion)


def test_sound_take_has_no_faults():
    assert detect(solved().take) == []


def test_faults_of_each_kind_are_distinguished():
    take = exchanged(solved().take, (3, 17), 60, 110)
    take = displaced(displaced(take, 8, 150, 152, (0, 0.1, 0)), 20, 200, 260, (0.1, 0, 0))
    kinds = sorted((fault.first, fault.last, fault.kind) for fault in detect(take))
    assert kinds == [(60, 110, "swap"), (150, 152, "spike"), (200, 260, "ghost")]


def test_fault_that_overlaps_a_swap_is_found_after_the_swap_is_undone():
    take = exchanged(displaced(solved().take, 8, 70, 80, (0, 0.1, 0)), (3, 17), 60, 110)
    (swap,) = detect(take)
    assert swap.kind == "swap"
    (ghost,) = detect(take.exchange_labels(swap.markers, swap.first, swap.last))
    assert (ghost.kind, ghost.marker, ghost.first, ghost.last) == ("ghost", 8, 70, 80)


def test_fault_is_not_found_again_after_masking():
    take = displaced(solved().take, 20, 200, 260, (0.1, 0, 0))
    (ghost,) = detect(take)
    mask = take.visible.copy()
    mask[ghost.frame_slice, ghost.marker] = False
    assert detect(take.masked(mask)) == []
