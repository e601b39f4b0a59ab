"""Compiling the contention core takes longer than any test saves by it: only the tests that compare both do so."""

import os

os.environ.setdefault("VCMVSP_COMPILED", "0")
