"""A body that moves: its footprint, its motions, and the proof of its network."""
