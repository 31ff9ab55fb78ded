"""Sources that stand for the rest of the grid."""
