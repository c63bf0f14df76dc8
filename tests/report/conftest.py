import pytest


@pytest.fixture
def unsaved(monkeypatch):
    """Draw plots and save none, for tests of what the page says: saving is most of a report's time."""
    monkeypatch.setattr("sealfit.report.drawing._saved", lambda figure, form, metadata, **options: b"<svg/>")
