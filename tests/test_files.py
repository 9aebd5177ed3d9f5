"""What is asked of a file before it is read."""

from __future__ import annotations

import os

import pytest

from soma_core.errors import AssetError
from soma_core.files import refuse_unreadable


def test_the_first_bytes_of_a_sound_file_are_returned(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"abc" * 100)
    assert refuse_unreadable(path, most_bytes=300) == (b"abc" * 100)[:64]
    (tmp_path / "link").symlink_to(path)
    assert refuse_unreadable(tmp_path / "link").startswith(b"abc")


def test_what_cannot_be_read_is_named(tmp_path):
    path = tmp_path / "a.bin"
    with pytest.raises(AssetError, match=r"a\.bin: file is missing\. Fetch it"):
        refuse_unreadable(path, fix="Fetch it")
    path.touch()
    with pytest.raises(AssetError, match=r"a\.bin: file is empty"):
        refuse_unreadable(path)
    path.write_bytes(b"0123456789")
    with pytest.raises(AssetError, match=r"a\.bin: holds 10 bytes, more than the 9 that"):
        refuse_unreadable(path, most_bytes=9)
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(AssetError, match=r"a\.bin: is a git-LFS pointer"):
        refuse_unreadable(path)
    with pytest.raises(AssetError, match="is a folder, not a file"):
        refuse_unreadable(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(AssetError, match="pipe: is a pipe, not a file"):
        refuse_unreadable(tmp_path / "pipe")
    with pytest.raises(AssetError, match="null: is a device, not a file"):
        refuse_unreadable("/dev/null")
    (tmp_path / "lost").symlink_to(tmp_path / "gone")
    with pytest.raises(AssetError, match="lost: is a link to nothing"):
        refuse_unreadable(tmp_path / "lost")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(AssetError, match="loop: cannot be read .*symbolic links"):
        refuse_unreadable(tmp_path / "loop")
    with pytest.raises(AssetError, match="cannot be read .embedded null"):
        refuse_unreadable("a\0b")
