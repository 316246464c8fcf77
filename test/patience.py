"""How long tests wait for what must come, before they give up."""

PATIENCE_S = 120.0
"""More than a machine with eight busy processes beside the tests takes for any of it."""
