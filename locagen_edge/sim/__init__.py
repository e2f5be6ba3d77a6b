"""Simulated sound and simulated delays, with the truth beside them."""
