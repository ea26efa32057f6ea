"""The map of the house names what is there, and every room."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
MAP = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PACKAGE = ROOT / "torch_pbd"


def test_files_and_folders_of_the_map_are_there():
    files = {path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py")}
    last_parts = {file.rpartition("/")[2] for file in files}
    named = re.findall(r"`([\w/]+\.py)`", MAP)
    assert len(named) > 40
    missing = [name for name in named if name not in files and not (ROOT / name).is_file()]
    assert [name for name in missing if "/" in name or name not in last_parts] == []
    folders = re.findall(r"`([\w/]+)/`", MAP)
    inside = [*PACKAGE.rglob("*"), *ROOT.iterdir()]
    known = {path.relative_to(ROOT).as_posix() for path in inside if path.is_dir()}
    assert [name for name in folders if not any(path.endswith(name) for path in known)] == []


def test_every_room_is_on_the_map():
    rooms = [path.name for path in PACKAGE.glob("[!_]*.py")] + [f"{path.name}/" for path in PACKAGE.glob("[!_]*/")]
    assert [room for room in rooms if f"`{room}`" not in MAP] == []


def test_the_map_is_one_page():
    assert len(MAP.splitlines()) < 120
