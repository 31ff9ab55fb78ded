"""Tap changers."""
