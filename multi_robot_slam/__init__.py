"""The estimate: one landmark map and all robots' paths from what the team sees."""
