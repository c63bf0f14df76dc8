import pytest
from steady_tables import steady_rows


@pytest.fixture
def campaign():
    return steady_rows
