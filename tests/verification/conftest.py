"""The checker of certificates in C, compiled once, where there is a compiler."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.campaigns.two_checkers import WRITTEN_OTHERWISE, build, difference


@pytest.fixture(scope="session")
def compiled(tmp_path_factory) -> Path | None:
    """The compiled checker, or nothing where it cannot be compiled."""
    try:
        return build(tmp_path_factory.mktemp("c"))
    except FileNotFoundError:
        return None


@pytest.fixture
def program(compiled) -> Path:
    """The compiled checker; tests that need it are skipped where there is none."""
    if compiled is None:
        pytest.skip("no compiler of C, or no headers of its libraries")
    return compiled


@pytest.fixture(autouse=True)
def second_checker(request, compiled) -> Iterator[None]:
    """Both checkers say the same of each certificate, true or false, that a test leaves behind."""
    yield
    left = request.node.funcargs.get("tmp_path")
    for path in () if left is None or compiled is None else left.iterdir():
        if path.is_file() and path.read_bytes()[:2] == b"\x1f\x8b":
            said = difference(compiled, path)
            assert not said or any(words in said for words in WRITTEN_OTHERWISE), said
