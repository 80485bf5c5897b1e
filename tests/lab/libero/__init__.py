"""Tests of `saccade_lab.libero` that need no simulator."""
