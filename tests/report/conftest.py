import pytest
from drawing_helpers import only_svg
from matplotlib.figure import Figure

from sealfit.report import drawing


@pytest.fixture
def unsaved(monkeypatch):
    """Draw figures and save none, for tests of what the page says: saving is most of a report's time."""
    monkeypatch.setattr(drawing, "compose", lambda plot: Figure())
    monkeypatch.setattr(drawing, "saved", lambda figure, form, metadata, **options: b"<svg/>")


@pytest.fixture(scope="module")
def only_drawings():
    """Save the figures as SVG, which the page shows, and not those for print, which OUT keeps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "saved", only_svg)
        yield
