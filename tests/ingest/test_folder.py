import os

import pytest

from sealfit.errors import BadFile
from sealfit.ingest.files import read_marked
from sealfit.store.manifest import fingerprint


def test_bytes_come_with_the_fingerprint_of_the_file(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "a.csv").write_bytes(b"1,2,3\n")
    raw, mark = read_marked(tmp_path, "sub/a.csv")
    assert raw == b"1,2,3\n"
    assert mark == fingerprint(tmp_path / "sub" / "a.csv")


def test_links_are_followed_and_none_leads_outside(tmp_path):
    campaign, outside = tmp_path / "c", tmp_path / "other"
    for folder in (campaign / "real", outside):
        folder.mkdir(parents=True)
        (folder / "a.csv").write_bytes(folder.name.encode())
    (campaign / "linked").symlink_to(campaign / "real")
    (campaign / "away").symlink_to(outside)
    (campaign / "real" / "file.csv").symlink_to(campaign / "real" / "a.csv")
    (campaign / "real" / "leak.csv").symlink_to(outside / "a.csv")
    (campaign / "loop").symlink_to(campaign / "loop")
    for file in ("real/a.csv", "linked/a.csv", "real/file.csv", "linked/file.csv", "real/../real/a.csv"):
        assert read_marked(campaign, file)[0] == b"real"
    away = ("away/a.csv", "real/leak.csv", "linked/leak.csv", "real/../../other/a.csv", "loop", "loop/a.csv")
    for file in (*away, "", "/a.csv", "C:/a.csv", "C:\\a.csv"):
        with pytest.raises(BadFile, match="outside the campaign"):
            read_marked(campaign, file)


def test_folders_and_closed_files_are_named(tmp_path):
    (tmp_path / "a.csv").mkdir()
    with pytest.raises(BadFile, match="is not a file"):
        read_marked(tmp_path, "a.csv")
    (tmp_path / "b.csv").write_text("1")
    (tmp_path / "b.csv").chmod(0)
    if not os.access(tmp_path / "b.csv", os.R_OK):  # root may read everything
        with pytest.raises(BadFile, match="cannot be read"):
            read_marked(tmp_path, "b.csv")
