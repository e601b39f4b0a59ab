"""What holds for all tests."""

import os

from hypothesis import settings

# Compiling the contention core takes longer than any test saves by it: only the tests that compare both do so.
os.environ.setdefault("VCMVSP_COMPILED", "0")
settings.register_profile("here", deadline=None)  # how long an example takes depends on what else the machine does
settings.load_profile("here")
