"""Options that several commands have."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.cli.options import pose_of
from vcmvsp.cosim.errors import UsageError

NUMBERS = st.floats(-1e6, 1e6)


@given(NUMBERS, NUMBERS, NUMBERS)
def test_poses(x: float, y: float, yaw: float) -> None:
    assert pose_of(f"{x},{y},{yaw}") == (x, y, yaw)


@pytest.mark.parametrize("text", ["1,2", "1,2,3,4", "a,b,c", "1,2,nan", "1,2,inf", ""])
def test_invalid_poses(text: str) -> None:
    with pytest.raises(UsageError, match="--pose"):
        pose_of(text)
