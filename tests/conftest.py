"""What all tests share: drawn examples are the same on every machine and in every run."""

from hypothesis import settings

settings.register_profile("same everywhere", derandomize=True)
settings.load_profile("same everywhere")
