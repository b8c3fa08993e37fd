"""The paper's Cartesian space: joint positions as variables."""
