"""Denoisers: sounds, mixes on the fly, training, export, evaluation beside peers, tuning on one's own
drone.
"""
