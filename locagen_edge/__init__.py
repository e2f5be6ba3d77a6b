"""Hears a call for help under a drone's own rotors and tells the flight controller where it comes from."""

__version__ = "0.1.0"
