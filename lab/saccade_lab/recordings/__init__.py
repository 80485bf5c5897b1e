"""What the lab adds to ``saccade evaluate`` and ``saccade diagnose``: processes, curves and pages.

The commands find it by entry points.
"""
