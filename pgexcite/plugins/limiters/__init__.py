"""Excitation limiters."""
