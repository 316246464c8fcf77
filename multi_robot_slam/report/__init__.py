"""Pictures of a run, and the page to explore it."""
