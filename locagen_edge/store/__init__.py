"""What is kept on disk: recordings, and the black box. Bounded, and whole after a loss of power."""
