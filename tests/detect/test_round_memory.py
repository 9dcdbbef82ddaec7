import numpy as np

from mocapfix.detect.noise import RoundMemory

SOME, FEWER, OTHER = np.array([[1, 1, 0, 1], [1, 0, 0, 1], [1, 0, 1, 0]], bool)


def test_result_is_computed_again_only_for_other_samples():
    memory, calls = RoundMemory(), list[str]()

    def recall(name, *is_used, key="chain"):
        def compute(marker):
            calls.append(f"{name} {marker}")
            return name

        return memory.recall(key, np.stack(is_used, axis=1), compute)

    assert recall("a", SOME, OTHER) == ["a", "a"]
    assert recall("b", SOME, SOME) == ["a", "b"]
    assert recall("c", FEWER, SOME) == ["c", "b"]
    assert recall("d", FEWER, SOME, key="jitter") == ["d", "d"]
    assert calls == ["a 0", "a 1", "b 1", "c 0", "d 0", "d 1"]


def test_fewer_samples_are_not_searched_where_more_gave_nothing():
    memory = RoundMemory()

    def recall(is_used, result):
        return memory.recall("stretches", is_used[:, None], lambda _: result, can_appear=False)[0]

    assert recall(SOME, []) == recall(FEWER, ["not searched"]) == []
    assert recall(OTHER, ["found"]) == ["found"]
