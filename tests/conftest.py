"""Settings of all tests."""

from hypothesis import settings

settings.register_profile("steady", deadline=None, derandomize=True)  # machines are noisy, and a test must not be
settings.load_profile("steady")
