import pytest

from sealfit.report.style import Drawn, Image


@pytest.fixture
def undrawn(monkeypatch):
    """Leave plots undrawn, for tests of what the page says: drawing is most of a report's time."""

    def draw(plot):
        return Drawn("<svg/>", b"", tuple(Image("<svg/>", 341, 245) for _ in plot.panels))

    monkeypatch.setattr("sealfit.report.page.draw", draw)
