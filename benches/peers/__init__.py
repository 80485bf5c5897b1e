"""Comparison of saccade with other engines that run the same head: `make bench-peers`."""
