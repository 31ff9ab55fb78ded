"""Estimators of what a unit's terminals do not show."""
