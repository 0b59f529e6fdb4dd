"""What all tests share: where the golden numbers of the released code are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_BESIDE_THE_REPOSITORY = Path(__file__).parents[2] / "shared" / "golden"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--golden",
        type=Path,
        default=None,
        metavar="DIR",
        help="folder of numbers that the authors' released code computed, for tests/test_reference_parity.py;"
        f" by default $VUSFA_GOLDEN, or {_BESIDE_THE_REPOSITORY} where it exists",
    )


@pytest.fixture(scope="session")
def golden(request: pytest.FixtureRequest) -> Path:
    """The folder of golden numbers. A folder that was named must exist; without any, the test is skipped."""
    named = request.config.getoption("--golden") or os.environ.get("VUSFA_GOLDEN")
    if named:
        folder = Path(named)
        if not folder.is_dir():
            pytest.fail(
                f"{folder} is not a folder; --golden and $VUSFA_GOLDEN name the folder of golden numbers"
            )
        return folder
    if not _BESIDE_THE_REPOSITORY.is_dir():
        pytest.skip("no golden numbers here; name their folder with --golden DIR or $VUSFA_GOLDEN")
    return _BESIDE_THE_REPOSITORY
