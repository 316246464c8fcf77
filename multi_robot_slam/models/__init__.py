"""What sensors and wheels do: motion (7), stereo (8) (9), and what is kept of a frame."""
