"""Solvers of the predictive control problem."""
