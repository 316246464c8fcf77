"""The truth: a simulated building, its landmarks and the robots that drive through it."""
