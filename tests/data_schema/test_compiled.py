"""Compiled loops, with and without a place for their machine code."""

from __future__ import annotations

import pytest

from data_schema import compiled as module


def test_without_a_writable_cache_functions_are_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    real = module.njit

    def no_place(function=None, **options):
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return real(function)

    monkeypatch.setattr(module, "njit", no_place)
    assert module.compiled(lambda x: x + 1)(2) == 3
