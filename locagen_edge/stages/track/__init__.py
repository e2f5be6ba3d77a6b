"""Bearings, Detection and attitude -> Tracks: every caller over time.

filter.py        one direction on the unit sphere, its rate, and what they are worth
association.py   which bearing belongs to which track
tracker.py       birth, confirmation, coasting and death, in the earth's axes or the body's
"""

from locagen_edge.stages.track.tracker import Tracker

__all__ = ["Tracker"]
