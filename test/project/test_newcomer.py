"""The rooms that CONTRIBUTING names for a newcomer's questions are there and hold what they say."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text()
ROWS = re.findall(r"^\| ([^|]+\?) \| (.+) \|$", TEXT, re.MULTILINE)
HOLDS = {
    "association.py": "find_candidates",
    "kernels.py": "<= gate",
    "motion.py": "(7)",
    "rbpf.py": "Algorithm 1",
    "reorder.py": "late frame",
    "saving.py": "result.json",
    "consistency.py": "def nees",
}


def test_ten_questions_are_answered():
    assert len(ROWS) == 10


def test_every_room_named_is_there():
    named = [name for _, answer in ROWS for name in re.findall(r"`([^`]+)`", answer)]
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_the_rooms_hold_what_was_asked_for():
    files = {
        Path(name).name: ROOT / name
        for _, answer in ROWS
        for name in re.findall(r"`(\S+\.py)`", answer)
    }
    missing = [name for name, words in HOLDS.items() if words not in files[name].read_text()]
    assert missing == []
