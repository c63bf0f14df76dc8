import pytest

from sealfit.report import drawing

SAVED = drawing._saved


@pytest.fixture
def unsaved(monkeypatch):
    """Draw plots and save none, for tests of what the page says: saving is most of a report's time."""
    monkeypatch.setattr(drawing, "_saved", lambda figure, form, metadata, **options: b"<svg/>")


@pytest.fixture(scope="module")
def only_svg():
    """Save plots as SVG alone, for tests of what the page shows."""

    def saved(figure, form, metadata, **options):
        return SAVED(figure, form, metadata, **options) if form == "svg" else b""

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "_saved", saved)
        yield
