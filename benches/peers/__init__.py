"""saccade beside every engine that can run the same head: what `make bench-peers` measures and reports."""
