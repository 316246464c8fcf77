"""Machine code follows its sources, whichever file an edit is in."""

import shutil
import subprocess
import sys
from pathlib import Path

import numba

from multi_robot_slam.models import compiled

CALLER = """
from package.models.callee import one
from package.models.compiled import kernel

@kernel
def two(x):
    return one(x) + one(x)

print(two(1.0))
"""
CALLEE = """
from package.models.compiled import kernel

@kernel
def one(x):
    return {value} * x
"""


def package(folder):
    models, filters = folder / "package" / "models", folder / "package" / "filter"
    for room in (models, filters):
        room.mkdir(parents=True)
    shutil.copy(compiled.__file__, models / "compiled.py")
    (filters / "caller.py").write_text(CALLER)
    return models / "callee.py"


def run(folder):
    command = [sys.executable, "-m", "package.filter.caller"]
    return subprocess.check_output(command, cwd=folder, text=True).strip()


def test_an_edit_of_a_callee_in_another_file_is_followed(tmp_path):
    callee = package(tmp_path)
    callee.write_text(CALLEE.format(value=1.0))
    assert run(tmp_path) == "2.0"
    callee.write_text(CALLEE.format(value=3.0))
    assert run(tmp_path) == "6.0"
    folders = list((callee.parent / "__pycache__").glob(f"{compiled.PREFIX}*"))
    assert len(folders) == 1, "what older sources left is removed"


def test_the_same_sources_are_compiled_once(tmp_path):
    callee = package(tmp_path)
    callee.write_text(CALLEE.format(value=1.0))
    run(tmp_path)
    cache = callee.parent / "__pycache__"
    before = {file: file.stat().st_mtime_ns for file in cache.rglob("*.nbc")}
    assert before
    run(tmp_path)
    assert {file: file.stat().st_mtime_ns for file in cache.rglob("*.nbc")} == before


def test_every_compiled_room_is_part_of_the_name(tmp_path):
    root = Path(compiled.__file__).parents[1]
    for room in compiled.ROOMS:
        shutil.copytree(root / room, tmp_path / room)
    names = {compiled.digest(tmp_path)}
    for room in compiled.ROOMS:
        file = next((tmp_path / room).glob("[a-z]*.py"))
        file.write_text(file.read_text() + "# edited\n")
        names.add(compiled.digest(tmp_path))
    assert len(names) == 1 + len(compiled.ROOMS)


def test_the_user_s_own_cache_setting_stays():
    before = numba.config.CACHE_DIR
    compiled.kernel(lambda x: x)
    assert before == numba.config.CACHE_DIR
