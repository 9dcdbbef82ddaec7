"""Which compiled functions become machine code, and when."""

import numpy as np
import pytest
from numba import njit

from mocapfix.kernels.compilation_cache import DeferredCodeLibrary, compile_inner_kernel, compile_kernel


def count_upwards(n):
    if n < 0:
        raise ValueError("n is negative")
    return np.arange(n)


@pytest.fixture
def kernels(monkeypatch, tmp_path):
    """Two kernels, of which the second calls the first, that are not cached."""
    monkeypatch.setattr("mocapfix.kernels.compilation_cache.find_module_folder", lambda module: tmp_path)
    inner = compile_inner_kernel(count_upwards)

    def sum_upwards(n):
        return inner(n).sum()

    return inner, compile_kernel(sum_upwards)


def get_library(dispatcher):
    (overload,) = dispatcher.overloads.values()
    return overload.library


def test_only_what_python_calls_becomes_machine_code(kernels):
    inner, outer = kernels
    assert outer(4) == 6
    assert get_library(outer)._is_loaded
    assert isinstance(get_library(inner), DeferredCodeLibrary)
    assert not get_library(inner)._is_loaded
    assert get_library(inner).serialize_using_object_code()[1] == "bitcode"
    assert get_library(outer).serialize_using_object_code()[1] == "object"


def test_exceptions_of_inner_kernels_reach_python(kernels):
    with pytest.raises(ValueError, match="n is negative"):
        kernels[1](-1)


def test_an_inner_kernel_becomes_machine_code_when_its_address_is_needed(kernels):
    inner, outer = kernels
    outer(4)
    library, (overload,) = get_library(inner), inner.overloads.values()
    assert library.get_pointer_to_function("no_such_function") == 0
    assert library.get_pointer_to_function(overload.fndesc.llvm_func_name)
    assert library._is_loaded


def test_cached_machine_code_can_be_called_from_python_and_from_a_kernel(kernels):
    def count_all(n):
        return len(np.zeros(n))

    first = compile_kernel(count_all)
    assert first(4) == 4
    cached = compile_kernel(count_all)
    caller = compile_kernel(lambda n: cached(n) + 1)
    assert cached(5) == 5
    assert sum(cached.stats.cache_hits.values()) == 1
    assert get_library(cached)._intermediate_code
    assert caller(6) == 7
    assert not get_library(cached)._intermediate_code


def test_other_compiled_functions_are_not_affected(kernels):
    other = njit(lambda n: np.arange(n).sum())
    assert other(4) == kernels[1](4) == 6
    assert not isinstance(get_library(other), DeferredCodeLibrary)
