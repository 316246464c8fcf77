"""How good and how fast: the paper's section 7, accuracy, real robots, speed."""
