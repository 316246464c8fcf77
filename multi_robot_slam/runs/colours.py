"""The colour of each robot, the same in pictures, pages and exported clouds."""

ROBOT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Told apart by most colour-blind readers (Okabe, Ito: Color universal design, 2002)."""
