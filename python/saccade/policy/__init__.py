"""Policies in the robot's units: observation, prepare, encode, sample, units."""
