"""What all tests share: drawn examples are the same on every machine and in every run, and the longest come first."""

from hypothesis import settings

settings.register_profile("same everywhere", derandomize=True)
settings.load_profile("same everywhere")


def pytest_collection_modifyitems(items):
    """Whole flights first: begun last, a page's commands would run for minutes beside an idle processor."""
    items.sort(key=lambda item: "whole" not in item.path.parts)
