import numpy as np

from mocapfix.detect.noise import RoundMemory


def test_result_is_computed_again_only_for_other_samples():
    memory, calls = RoundMemory(), list[str]()

    def compute(name):
        calls.append(name)
        return name

    used = np.array([True, True, False, True])
    assert memory.recall(("chain", 0), used, lambda: compute("first")) == "first"
    assert memory.recall(("chain", 0), used.copy(), lambda: compute("second")) == "first"
    assert memory.recall(("chain", 1), used, lambda: compute("other marker")) == "other marker"
    assert memory.recall(("chain", 0), np.array([True, False, False, True]), lambda: compute("third")) == "third"
    assert calls == ["first", "other marker", "third"]
