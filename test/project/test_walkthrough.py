"""The walk through the filter works as shown, block after block."""

import re
from pathlib import Path

WALK = Path(__file__).parents[2] / "docs" / "walkthrough.md"


def test_every_block_runs_in_order():
    text = WALK.read_text()
    blocks = list(re.finditer(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL))
    assert len(blocks) > 8
    names = {}
    for block in blocks:
        line = text[: block.start(1)].count("\n")
        # Errors name the line of the page.
        exec(compile("\n" * line + block[1], WALK, "exec"), names)
