"""Files written whole: `torch_pbd.files`; the name `test_files` is that of the list of faults."""

import os
import stat

import pytest

from torch_pbd.files import remove_drafts, replacing

DRAFT = ".model.safetensors.4711.0123abcd.draft"


def write(path, content=b"new"):
    with replacing(path) as file:
        file.write(content)


def test_a_draft_is_named_so_that_it_is_found_again(tmp_path):
    names = []
    with replacing(tmp_path / "model") as file:
        file.write(b"half")
        names += [entry.name for entry in tmp_path.iterdir()]
    assert len(names) == 1
    assert names[0].startswith(f".model.{os.getpid()}.")
    (tmp_path / names[0]).write_bytes(b"half")
    remove_drafts(tmp_path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["model"]


@pytest.mark.parametrize("error", [KeyError, KeyboardInterrupt])
def test_an_error_of_the_writer_leaves_no_draft(error, tmp_path):
    (tmp_path / "model").write_bytes(b"old")
    with pytest.raises(error), replacing(tmp_path / "model"):
        raise error
    assert [entry.name for entry in tmp_path.iterdir()] == ["model"]
    assert (tmp_path / "model").read_bytes() == b"old"


def test_only_drafts_are_removed(tmp_path):
    others = [".model", ".hidden.draft", "model.12.0123abcd.draft", ".model.12.0123abcd", ".model.12.0123ABCD.draft"]
    for name in [*others, DRAFT]:
        (tmp_path / name).write_bytes(b"")
    (tmp_path / ".folder.12.0123abcd.draft").mkdir()
    remove_drafts(tmp_path)
    assert {entry.name for entry in tmp_path.iterdir()} == {*others, ".folder.12.0123abcd.draft"}


def test_a_link_stays_and_the_file_behind_it_is_replaced(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    file, link = folder / "model", tmp_path / "link"
    file.write_bytes(b"old")
    link.symlink_to("folder/model")
    write(link)
    assert link.is_symlink()
    assert (file.read_bytes(), link.read_bytes()) == (b"new", b"new")
    assert [entry.name for entry in folder.iterdir()] == ["model"]


def test_a_link_to_nothing_makes_the_file_it_leads_to(tmp_path):
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "model")
    write(link)
    assert link.is_symlink()
    assert (tmp_path / "model").read_bytes() == b"new"
    broken = tmp_path / "broken"
    broken.symlink_to(tmp_path / "nowhere" / "model")
    with pytest.raises(FileNotFoundError, match="nowhere does not exist: make it before saving broken"):
        write(broken)


def test_links_in_a_circle_are_told(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(OSError, match=r"links.*'.*/a'"):
        write(tmp_path / "a")
    assert {entry.name for entry in tmp_path.iterdir()} == {"a", "b"}


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664])
def test_a_file_keeps_its_permissions_while_it_is_written_too(mode, tmp_path):
    path = tmp_path / "model"
    path.write_bytes(b"old")
    path.chmod(mode)
    with replacing(path) as file:
        file.write(b"new")
        (draft,) = set(tmp_path.iterdir()) - {path}
        assert stat.S_IMODE(draft.stat().st_mode) == mode
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert path.read_bytes() == b"new"


def test_folders_and_pipes_are_not_replaced(tmp_path):
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(IsADirectoryError, match="folder"):
        write(tmp_path / "folder")
    with pytest.raises(OSError, match=r"a pipe or a device.*pipe"):
        write(tmp_path / "pipe")
    assert (tmp_path / "pipe").is_fifo()
    assert len(list(tmp_path.iterdir())) == 2


def test_the_folder_reaches_the_disk_after_the_file_has_its_name(tmp_path, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace

    def told_fsync(descriptor):
        done.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        fsync(descriptor)

    def told_replace(*names):
        done.append("name")
        replace(*names)

    monkeypatch.setattr(os, "fsync", told_fsync)
    monkeypatch.setattr(os, "replace", told_replace)
    write(tmp_path / "model")
    assert done == ["file", "name", "folder"]


@pytest.mark.parametrize(("number", "raised"), [(22, False), (1, False), (5, True)])
def test_a_folder_that_cannot_be_synced_is_no_error_but_a_broken_disk_is(number, raised, tmp_path, monkeypatch):
    fsync = os.fsync

    def failing(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", failing)
    if raised:
        with pytest.raises(OSError, match=r"Input/output.*model"):
            write(tmp_path / "model")
    else:
        write(tmp_path / "model")
    assert (tmp_path / "model").read_bytes() == b"new"


def test_an_error_without_a_number_is_passed_on(tmp_path):
    with pytest.raises(OSError, match=r"^the writer's own$"), replacing(tmp_path / "model"):
        raise OSError("the writer's own")
    assert list(tmp_path.iterdir()) == []
